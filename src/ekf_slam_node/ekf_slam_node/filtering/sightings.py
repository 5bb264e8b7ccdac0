# SPDX-License-Identifier: Apache-2.0
"""Landmarks as the cameras of a frame see them, each by its own lens and mounting.

Where a frame is of one camera alone these are the calls for that camera.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ekf_slam_node.filtering.covariance import IndexArray
from ekf_slam_node.filtering.ekf import Sighted
from ekf_slam_node.filtering.models import Frame, Observation, observe
from slam_core.geometry import FloatArray


def sighted_by(
    sighted: Callable[..., Sighted], frame: Frame, variance: FloatArray, slots: IndexArray, T_rig_optical: FloatArray,
    common: FloatArray,
) -> Sighted:  # fmt: skip
    """Landmarks ``slots`` (k,) beside the k measurements of a frame, taken to be of ``variance`` (k, 3).

    ``sighted``: the filter's own method for one camera, see :mod:`ekf_slam_node.filtering.ekf`.
    """
    if not frame.cameras:
        return sighted(frame.z, variance, slots, T_rig_optical, frame.camera, common)
    k = len(slots)
    seen = Observation(np.empty((k, 3)), np.empty(k), np.empty((k, 3, 6)), np.empty((k, 3, 3)))
    found = Sighted(seen, np.empty((k, 3)), np.empty(k), np.empty(k))
    for index, camera, T in frame.parts(T_rig_optical):
        own = sighted(frame.z[index], variance[index], slots[index], T, camera, common)
        _put(seen, index, own.seen)
        found.innovation[index], found.nis[index] = own.innovation, own.nis
        found.information[index] = own.information
    return found


def observed_by(frame: Frame, T_parent_rig: FloatArray, T_rig_optical: FloatArray, points: FloatArray) -> Observation:
    """Points (n, 3) in the parent frame as the cameras of the n measurements would see them, one by one."""
    if not frame.cameras:
        return observe(T_parent_rig, T_rig_optical, points, frame.camera)
    n = len(points)
    seen = Observation(np.empty((n, 3)), np.empty(n), np.empty((n, 3, 6)), np.empty((n, 3, 3)))
    for index, camera, T in frame.parts(T_rig_optical):
        _put(seen, index, observe(T_parent_rig, T, points[index], camera))
    return seen


def in_view(
    frame: Frame, T_parent_rig: FloatArray, T_rig_optical: FloatArray, points: FloatArray, margin_px: float
) -> np.ndarray:
    """Mask of the points (n, 3) in the parent frame inside the image of any camera of a frame."""
    seen = np.zeros(len(points), dtype=bool)
    for _, camera, T in frame.parts(T_rig_optical):
        seen |= observe(T_parent_rig, T, points, camera).in_image(camera, margin_px)
    return seen


def _put(out: Observation, index: slice | np.ndarray, own: Observation) -> None:
    out.z[index], out.depth[index], out.J_pose[index], out.J_point[index] = own.z, own.depth, own.J_pose, own.J_point
