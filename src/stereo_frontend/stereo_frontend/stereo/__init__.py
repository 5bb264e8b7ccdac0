# SPDX-License-Identifier: Apache-2.0
"""Rectified pairs: matching, disparity, and their calibration while they run."""
