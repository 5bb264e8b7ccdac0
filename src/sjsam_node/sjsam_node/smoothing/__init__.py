# SPDX-License-Identifier: Apache-2.0
"""The estimate: everything that is written to poses and points is written here."""
