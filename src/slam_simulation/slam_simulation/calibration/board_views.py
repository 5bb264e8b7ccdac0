# SPDX-License-Identifier: Apache-2.0
"""A rig looking at a board: exact corners plus noise, to try a calibration where the truth is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_calibration.bundle import LensState
from slam_calibration.detection import Corners
from slam_core.geometry import FloatArray, boxplus, make_transform, so3_exp, transform_points

EXAMPLE_LENSES: dict[str, tuple[int, int, tuple[float, ...]]] = {
    "none": (640, 480, (520.0, 523.0, 318.0, 243.0)),
    "plumb_bob4": (204, 204, (282.0, 280.0, 100.0, 103.5, -0.38, 0.21, 0.001, -0.002)),
    "plumb_bob": (640, 480, (535.0, 536.5, 330.0, 236.0, -0.28, 0.09, 0.001, -0.0005, -0.01)),
    "rational_polynomial": (640, 480, (400.0, 401.0, 322.0, 238.0, 0.3, 0.05, 5e-4, -4e-4, 0.002, 0.5, 0.11, 0.006)),
    "equidistant": (640, 480, (285.0, 286.0, 318.0, 242.0, -0.01, 0.03, -0.02, 0.005)),
}
"""Width, height and parameters of a plausible camera for each lens model."""


def random_view(rng: np.random.Generator, tilt: float = 0.6) -> FloatArray:
    """T_first_board: the board's middle near the axis, 0.45 to 0.9 m away, tilted by up to ``tilt`` rad."""
    rotation = so3_exp(np.array([*rng.uniform(-tilt, tilt, 2), 0.0])) @ so3_exp(
        np.array([0, 0, rng.uniform(-0.5, 0.5)])
    )
    return make_transform(rotation, np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.45, 0.9)]))


def covering_view(rng: np.random.Generator, camera: LensState, tilt: float = 0.6) -> FloatArray:
    """T_first_board: the board anywhere in the picture, 0.35 to 0.8 m away, turned to the camera but for ``tilt`` rad.

    A lens is known where the board was seen: twenty such views fill the picture, as a user is asked to.
    """
    depth = rng.uniform(0.35, 0.8)
    reach = 0.75 * np.array([camera.width / camera.parameters[0], camera.height / camera.parameters[1]]) / 2.0
    position = depth * np.array([*rng.uniform(-reach, reach), 1.0])
    turn = np.array([-position[1], position[0], 0.0]) / depth
    facing = so3_exp(turn * np.arctan(np.linalg.norm(turn)) / max(float(np.linalg.norm(turn)), 1e-9))
    tilted = so3_exp(np.array([*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.5, 0.5)]))
    return make_transform(facing @ tilted, position)


def simulate_views(
    rng: np.random.Generator,
    board_points: FloatArray,
    cameras: Sequence[LensState],
    poses: Sequence[FloatArray],
    noise_px: float,
) -> list[list[Corners]]:
    """Simulated views of the cameras: visible corners with noise of ``noise_px`` per axis.

    ``poses``: T_first_board of each view, for a board whose origin is moved to its middle.
    """
    views = []
    centre = board_points.mean(axis=0)
    for T_first_board in poses:
        view = []
        for state in cameras:
            points = transform_points(state.T @ T_first_board, board_points - centre)
            pixels = state.camera.project(points)
            inside = ((pixels > 3.0) & (pixels < [state.width - 4.0, state.height - 4.0])).all(axis=1)
            ids = np.flatnonzero(inside)
            view.append(Corners(ids, pixels[ids] + noise_px * rng.normal(size=(len(ids), 2))))
        views.append(view)
    return views


def example_camera(lens: str, T: FloatArray | None = None) -> LensState:
    """A plausible camera of each lens model, at ``T`` = T_camera_first (None: the first camera itself)."""
    width, height, parameters = EXAMPLE_LENSES[lens]
    return LensState(lens, width, height, np.array(parameters), np.eye(4) if T is None else T)


def beside(x: float, y: float, angles: Sequence[float]) -> FloatArray:
    """T_camera_first of a camera at (x, y, 0) m in the first one's frame, turned a little."""
    return boxplus(np.eye(4), np.array([-x, -y, 0.0, *angles]))
