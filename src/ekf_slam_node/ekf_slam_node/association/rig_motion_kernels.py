# SPDX-License-Identifier: Apache-2.0
"""The compiled kernel of the motion of a rig with several cameras: the best of many samples.

A sample may hold points of different cameras: all are in the rig's frame. Each pair's cost is that in the image of its
own camera, with its row of ``T_optical_rig`` (c, 4, 4) and ``lenses`` (c, 4; fx, fy, cx, cy).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ekf_slam_node.association.motion_kernels import draw_three, motion_of_three
from slam_core.camera import MIN_DEPTH
from slam_core.runtime.in_place import in_place


@njit(cache=True, nogil=True, error_model="numpy")
def best_sample_of_rig(before, now, spread, z, variance, T_optical_rig, lenses, seen_by, draws, first, gate):  # type: ignore[no-untyped-def]
    """Motion T_now_previous (4, 4) of the rig with the least truncated cost (MSAC, Torr and Zisserman 2000).

    Points ``before`` and ``now`` (n, 3) in the rig's frame; ``spread`` (n, 2): variances of the former across and along
    the camera's axis. Competes with ``first`` (k, 4, 4): for each row of ``draws`` (h, 3) the motion of three pairs.
    """
    best, motion, least = np.eye(4), np.eye(4), np.inf
    sample = np.empty(3, np.int64)
    for h in range(len(first) + len(draws)):
        if h < len(first):
            motion[:] = first[h]
        else:
            draw_three(draws[h - len(first)], len(before), sample)
            motion_of_three(before, now, sample, motion)
        cost = _cost(motion, before, spread, z, variance, T_optical_rig, lenses, seen_by, gate, least)
        if cost < least:
            least = cost
            best[:] = motion
    return best


@in_place(error_model="numpy")
def _cost(M, points, spread, z, variance, T_optical_rig, lenses, seen_by, gate, enough):  # type: ignore[no-untyped-def]
    """Truncated cost of a motion; what is beyond ``enough`` is not summed up to its end."""
    total = 0.0
    for i in range(len(points)):
        a = M[0, 0] * points[i, 0] + M[0, 1] * points[i, 1] + M[0, 2] * points[i, 2] + M[0, 3]
        b = M[1, 0] * points[i, 0] + M[1, 1] * points[i, 1] + M[1, 2] * points[i, 2] + M[1, 3]
        c = M[2, 0] * points[i, 0] + M[2, 1] * points[i, 1] + M[2, 2] * points[i, 2] + M[2, 3]
        T, lens = T_optical_rig[seen_by[i]], lenses[seen_by[i]]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        d = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        cost = gate
        if d >= MIN_DEPTH:
            w = 1.0 / d
            du, dv, dw = z[i, 0] - lens[0] * x * w - lens[2], z[i, 1] - lens[1] * y * w - lens[3], z[i, 2] - w
            su = variance[i, 0] + spread[i, 0] * (lens[0] * w) ** 2
            sv = variance[i, 1] + spread[i, 0] * (lens[1] * w) ** 2
            sw = variance[i, 2] + spread[i, 1] * (w * w) ** 2
            cost = min(du * du / su + dv * dv / sv + dw * dw / sw, gate)
        total += cost
        if total >= enough:
            break
    return total
