# SPDX-License-Identifier: Apache-2.0
"""Files and folders of results: written whole or not at all, users' own kept."""
