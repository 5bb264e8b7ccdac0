# SPDX-License-Identifier: Apache-2.0
"""The true cameras behind a calibration from pictures of a board, and what that calibration says of its errors.

Errors of single parameters that are drawn alone bend disparities by tenths of a pixel. Those of a real calibration
compensate each other where the board was seen: so the pair is calibrated here, from simulated corners, and the cameras
that render differ from the published calibration by the error that was made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_calibration.board import Chessboard
from slam_calibration.bundle import LensState, Rig, adjust
from slam_calibration.length_error import PairError, pair_error
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform
from slam_simulation.calibration.board_views import covering_view, simulate_views

_BOARD = Chessboard(9, 7, 0.04).points


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """True cameras, their places ``T_rectified_raw`` (4, 4) in the left rectified frame, and the claimed errors."""

    cameras: tuple[Camera, ...]
    T_rectified_raw: tuple[FloatArray, ...]
    error: PairError


def calibrated_pair(
    infos: tuple[CameraInfo, ...], baseline: float, pictures: int, corner_px: float, rng: np.random.Generator
) -> CalibratedPair:
    """A pair whose calibration ``infos`` was made from so many pictures of a board; 0: it is exact.

    ``baseline`` in m; ``corner_px``: noise of a corner, px per axis.
    """
    T_rectified_raw = tuple(
        make_transform(info.R, np.array([x, 0.0, 0.0])) for info, x in zip(infos, (0.0, baseline), strict=True)
    )
    if pictures == 0:
        return CalibratedPair(tuple(i.camera for i in infos), T_rectified_raw, PairError())
    T_right_left = invert_transform(T_rectified_raw[1]) @ T_rectified_raw[0]
    states = [_state(info.camera, T) for info, T in zip(infos, (np.eye(4), T_right_left), strict=True)]
    poses = [covering_view(rng, states[0]) for _ in range(pictures)]
    views = simulate_views(rng, _BOARD, states, poses, corner_px)
    found = adjust(_BOARD - _BOARD.mean(axis=0), views, Rig(tuple(states), tuple(poses)))
    left, right = (s.parameters - f.parameters for s, f in zip(states, found.rig.cameras, strict=True))
    T_true = boxplus(T_right_left, boxminus(T_right_left, found.rig.cameras[1].T))
    return CalibratedPair(
        (_moved(infos[0].camera, left), _moved(infos[1].camera, right)),
        (T_rectified_raw[0], T_rectified_raw[0] @ invert_transform(T_true)),
        pair_error(states, found.covariance),
    )


def _state(camera: Camera, T: FloatArray) -> LensState:
    parameters = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    return LensState(camera.distortion_model, camera.width, camera.height, parameters, T)


def _moved(camera: Camera, change: FloatArray) -> Camera:
    values = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]) + change
    fx, fy, cx, cy, *distortion = values.tolist()
    return Camera(camera.width, camera.height, fx, fy, cx, cy, camera.distortion_model, tuple(distortion))
