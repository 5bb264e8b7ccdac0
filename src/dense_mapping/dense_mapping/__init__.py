# SPDX-License-Identifier: Apache-2.0
"""Dense model and floor plan: stereo and ToF depth fused in a TSDF on the optimised trajectory."""
