# SPDX-License-Identifier: Apache-2.0
"""3D visual EKF-SLAM that builds small, locally referenced submaps."""
