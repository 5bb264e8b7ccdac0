# SPDX-License-Identifier: Apache-2.0
"""NDT and ICP registration of point clouds, and scan odometry."""
