# SPDX-License-Identifier: Apache-2.0
"""Facts and beliefs: submaps, the landmarks that they share, and the links that say so."""
