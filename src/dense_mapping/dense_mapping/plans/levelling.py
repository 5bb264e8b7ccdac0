# SPDX-License-Identifier: Apache-2.0
"""Levelling of the map: its vertical, and the heights of its floors.

The map's Z axis is that of the first rig pose, and a handheld rig starts at an angle. Up is first what gravity says,
or, without an IMU, where the upper edges of the images pointed on the whole; then floors and ceilings say it exactly.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dense_mapping.reconstruction.surface import Surface
from slam_core.geometry import FloatArray, make_transform, so3_exp

_NORMAL_CONES_DEG = (25.0, 10.0, 5.0)
_GRAVITY_CONES_DEG = (5.0, 3.0)
"""Surfaces that are level to this angle are taken for floors and ceilings, step by step."""
_BIN_M = 0.05
_UPWARD = 0.9
_LEAST_SHARE = 0.15
"""A floor is seen at least as much, of what is seen most of all level surfaces."""
_SURELY_WALKED, _LEAST_STOREY = 3, 0.5
"""Below so many key frames the share is that of its own storey, which may be seen this much less than another one."""


def up_direction(surface: Surface, image_ups: FloatArray, gravity_up: FloatArray | None = None) -> FloatArray:
    """Unit vector (3,) upwards in the map frame.

    Parameters
    ----------
    surface
        The dense model, whose floors and ceilings level it.
    image_ups
        (n, 3) direction of the upper edge of each key frame's image, map frame.
    gravity_up
        (3,) mean specific force in the map frame, if there is an IMU.
    """
    guess = np.sum(image_ups, axis=0) if gravity_up is None else gravity_up
    if not np.linalg.norm(guess) > 0.0:
        return np.array([0.0, 0.0, 1.0])
    up = guess / np.linalg.norm(guess)
    normals = surface.normals.astype(np.float64)
    for cone in _NORMAL_CONES_DEG if gravity_up is None else _GRAVITY_CONES_DEG:
        along = normals @ up
        level = np.abs(along) > np.cos(np.radians(cone))
        if level.sum() < 100:
            break
        mean = (normals[level] * np.sign(along[level])[:, None]).sum(axis=0)
        up = mean / np.linalg.norm(mean)
    return np.asarray(up)


def level_transform(up: FloatArray) -> FloatArray:
    """T_level_map (4, 4): the least turn that makes ``up`` (3,) the Z axis."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    angle = np.arctan2(sine, cosine)
    if sine < 1e-9:
        axis, sine = np.array([1.0, 0.0, 0.0]), 1.0
    return make_transform(so3_exp(axis / sine * angle), np.zeros(3))


def floor_heights(
    points: FloatArray, normals: FloatArray, cameras: FloatArray, storey_height: float, camera_height: float
) -> FloatArray:
    """Heights (k,) m of the floors that were walked on, lowest first.

    Parameters
    ----------
    points, normals
        Dense model, levelled, (n, 3).
    cameras
        Where the cameras were, levelled, (m, 3).
    storey_height
        Least height from one floor to the next, m.
    camera_height
        Height of the cameras above the floor, m, where no floor was seen.
    """
    heights = points[normals[:, 2] > _UPWARD, 2]
    below = heights[heights < cameras[:, 2].max() - 0.3] if len(cameras) else heights[:0]
    if len(below) < 50:
        return np.array([cameras[:, 2].min() - camera_height]) if len(cameras) else np.zeros(1)
    floors: list[float] = []
    bins = np.arange(below.min() - _BIN_M, below.max() + 2 * _BIN_M, _BIN_M)
    counts = np.convolve(np.histogram(below, bins)[0], np.ones(3), mode="same")
    middles = bins[:-1] + 0.5 * _BIN_M
    above = cameras[None, :, 2] - middles[:, None]
    # Treads of stairs are as large as what is seen of a floor, but few cameras were above them.
    walked = ((above > 0.3) & (above < storey_height)).sum(axis=1)
    for k in np.argsort(-counts * walked, kind="stable"):
        height = float(middles[k])
        nearby = counts[np.abs(middles - height) < storey_height].max()
        most = counts.max() if walked[k] < _SURELY_WALKED else max(nearby, _LEAST_STOREY * counts.max())
        is_floor = counts[k] >= _LEAST_SHARE * most and walked[k] > 0
        if is_floor and all(abs(height - other) >= storey_height for other in floors):
            floors.append(float(np.median(below[np.abs(below - height) < 0.1])))
    return np.array(sorted(floors)) if floors else np.array([float(np.percentile(below, 5))])


def storey_of(cameras: FloatArray, floors: FloatArray) -> npt.NDArray[np.int64]:
    """Index (m,) into ``floors`` of the storey that each camera (m, 3) was on: the highest floor below it."""
    below = (cameras[:, 2:] - 0.3 > floors[None, :]).sum(axis=1)
    return np.asarray(np.maximum(below - 1, 0))
