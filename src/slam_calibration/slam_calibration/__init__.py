# SPDX-License-Identifier: Apache-2.0
"""Camera calibration from pictures of a board: intrinsics, distortion and extrinsics with their uncertainties (2.4)."""
