# SPDX-License-Identifier: Apache-2.0
"""The thesis's planar estimators: EKF, smoothing, SEIF, submaps."""
