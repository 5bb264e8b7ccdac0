# SPDX-License-Identifier: Apache-2.0
"""What is known: submaps, the landmarks that they share, and the links that say so."""
