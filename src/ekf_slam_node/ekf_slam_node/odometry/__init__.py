# SPDX-License-Identifier: Apache-2.0
"""Motion from other sensors, an IMU above all, and the odometry frame."""
