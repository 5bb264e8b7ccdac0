# SPDX-License-Identifier: Apache-2.0
"""Geometry, cameras, data types, least squares, evaluation and simulation: everything the SLAM packages share."""
