# SPDX-License-Identifier: Apache-2.0
"""A first guess for the bundle: focal length, board poses, camera positions."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slam_calibration.bundle import LensState, Views
from slam_calibration.detection import Corners
from slam_calibration.lens import parameter_names
from slam_core.camera import Camera
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform, transform_points
from slam_core.types import AnyArray

MINIMUM_CORNERS = 6


def is_posable(board_points: FloatArray, corners: Corners) -> bool:
    """True if a picture shows enough of the board for a pose: corners that are not few and not all on one line."""
    if len(corners) < MINIMUM_CORNERS:
        return False
    points = board_points[corners.ids, :2]
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 0.05 * spread[0])


def initial_lens(board_points: FloatArray, views: Sequence[Corners], width: int, height: int, lens: str) -> LensState:
    """A lens without distortion whose focal length explains the views best.

    Tried are Zhang's closed form (2000) and a ladder of focal lengths, so that a strong fisheye, which misleads the
    closed form, still starts near enough.
    """
    focal = [ratio * width for ratio in (0.3, 0.4, 0.55, 0.75, 1.0, 1.4, 2.0)]
    closed_form = _zhang(board_points, views, width, height)
    if closed_form is not None:
        focal.append(closed_form)
    states = [_undistorted_lens(lens, width, height, f) for f in focal]
    errors = [np.median([board_pose(board_points, seen, state)[1] for seen in views if len(seen)]) for state in states]
    return states[int(np.argmin(errors))]


def _undistorted_lens(lens: str, width: int, height: int, focal: float) -> LensState:
    parameters = np.zeros(len(parameter_names(lens)))
    parameters[:4] = focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)
    return LensState(lens, width, height, parameters, np.eye(4))


def _zhang(board_points: FloatArray, views: Sequence[Corners], width: int, height: int) -> float | None:
    seen = [corners for corners in views if len(corners)]
    objects = [board_points[corners.ids].astype(np.float32) for corners in seen]
    pixels = [corners.pixels.astype(np.float32) for corners in seen]
    try:
        K = cv2.initCameraMatrix2D(objects, pixels, (width, height), 0)
    except cv2.error:
        return None
    focal = float(np.sqrt(abs(K[0, 0] * K[1, 1])))
    return focal if np.isfinite(focal) and 0.1 * width < focal < 20.0 * width else None


def board_pose(board_points: FloatArray, corners: Corners, state: LensState) -> tuple[FloatArray, float]:
    """``T_camera_board`` of one view and its rms reprojection error (px); infinite where there is no pose.

    A plane seen from afar allows two poses (Collins and Bartoli 2014); the one with the smaller error is taken.
    """
    camera = state.camera
    ideal = camera.normalised_from_pixels(corners.pixels)
    good = np.isfinite(ideal).all(axis=1)
    if good.sum() < 4:
        return np.eye(4), np.inf
    points, pixels = board_points[corners.ids[good]], corners.pixels[good]
    centre = points.mean(axis=0)
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        points - centre, ideal[good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    candidates = [_candidate(r, t, centre) for r, t in zip(rotations, translations, strict=True)]
    errors = [_rms(camera, T, points, pixels) for T in candidates]
    best = int(np.argmin(errors)) if errors else 0
    return (candidates[best], errors[best]) if errors else (np.eye(4), np.inf)


def _candidate(rotation: AnyArray, translation: AnyArray, centre: FloatArray) -> FloatArray:
    R = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
    return make_transform(R, np.asarray(translation, dtype=np.float64).ravel() - R @ centre)


def _rms(camera: Camera, T: FloatArray, points: FloatArray, pixels: FloatArray) -> float:
    error = camera.project(transform_points(T, points)) - pixels
    rms = float(np.sqrt(np.square(error).sum(axis=1).mean()))
    return rms if np.isfinite(rms) else np.inf


def initial_extrinsics(board_points: FloatArray, views: Views, states: Sequence[LensState], c: int) -> FloatArray:
    """``T_camera_first`` of camera ``c`` from the board poses of the views that both cameras saw: a robust average.

    Raises
    ------
    ValueError
        If no view was seen by both.
    """
    relative = []
    for view in views:
        if len(view[0]) and len(view[c]):
            T_first, error_first = board_pose(board_points, view[0], states[0])
            T_camera, error_camera = board_pose(board_points, view[c], states[c])
            if np.isfinite(error_first + error_camera):
                relative.append(T_camera @ invert_transform(T_first))
    if not relative:
        raise ValueError(f"no picture pair shows the board to both camera 1 and camera {c + 1}")
    return _median_transform(np.array(relative))


def _median_transform(transforms: FloatArray) -> FloatArray:
    """The transform with the smallest sum of distances to the others, then the median of the deviations from it."""
    deviations = boxminus(transforms[:, None], transforms[None])
    centre = transforms[int(np.argmin(np.linalg.norm(deviations, axis=2).sum(axis=0)))]
    return boxplus(centre, np.median(boxminus(transforms, centre), axis=0))
