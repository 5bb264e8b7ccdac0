# SPDX-License-Identifier: Apache-2.0
"""Keypoint detectors and what their features have in common."""
