# SPDX-License-Identifier: Apache-2.0
"""Stereo camera driver, feature extraction (SURF-128, SIFT and others), stereo matching and depth fusion."""
