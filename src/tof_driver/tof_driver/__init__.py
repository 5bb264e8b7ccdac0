# SPDX-License-Identifier: Apache-2.0
"""Time-of-flight camera driver: range images to rectified depth with per-pixel uncertainty."""
