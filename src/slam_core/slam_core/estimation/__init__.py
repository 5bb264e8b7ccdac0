# SPDX-License-Identifier: Apache-2.0
"""Least squares, statistics and alignment that several packages share."""
