# SPDX-License-Identifier: Apache-2.0
"""2D SLAM: the thesis's estimators (EKF, smoothing, SEIF, submaps), and range-bearing logs that they map."""
