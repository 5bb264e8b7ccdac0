# SPDX-License-Identifier: Apache-2.0
"""Range-bearing logs of robots in the plane: read, mapped by EKF, SAM or joined submaps, compared with the truth."""
