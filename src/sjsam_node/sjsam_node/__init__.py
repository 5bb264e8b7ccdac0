# SPDX-License-Identifier: Apache-2.0
"""Submap Joining Smoothing and Mapping: joins submaps by sparse least squares into one map."""
