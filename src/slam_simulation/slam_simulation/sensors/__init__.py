# SPDX-License-Identifier: Apache-2.0
"""The simulated stereo camera, ToF camera and IMU."""
