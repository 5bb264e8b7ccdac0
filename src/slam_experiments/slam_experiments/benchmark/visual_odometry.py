# SPDX-License-Identifier: Apache-2.0
"""The plain peer: SIFT, ratio test and PnP with RANSAC from frame to frame; no code in common with the estimators."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from slam_bags.reading.readings import AgentSensors, DepthReading, Reading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_core.geometry import FloatArray, invert_transform, make_transform
from slam_core.trajectory import Trajectory
from slam_core.types import AnyArray, PoseEstimate, StereoImages
from stereo_frontend.stereo.rectify import StereoRectifier

_FEATURES = 1500
_RATIO = 0.8
_LEAST_INLIERS = 20
_LARGEST_STEP_M = 3.0
_MOST_ROWS_APART_PX = 1.5
_LEAST_DISPARITY_PX = 3.0
_NEAREST_M = 0.1


@dataclass(frozen=True, eq=False)
class _Frame:
    """Keypoints (n, 2) px, descriptors (n, 128), points (n, 3) in the optical frame (NaN: unknown) and K (3, 3)."""

    uv: FloatArray
    descriptors: AnyArray
    points: FloatArray
    K: FloatArray


def frame_to_frame(bag: Path, mode: str) -> tuple[Trajectory, int]:
    """Poses of the rig by SIFT and PnP, and how many steps were not found; these repeat the motion before."""
    stamps: list[int] = []
    poses, lost, motion = [np.eye(4)], 0, np.eye(4)
    before: _Frame | None = None
    with SensorBag(bag) as opened:
        sensors = opened.sensors[opened.agents[0]]
        T_base = sensors.transform("base", "tof" if mode == "tof" else "left")
        for reading in opened.readings():
            frame = _frame(reading, sensors, mode)
            if frame is None:
                continue
            stamps.append(reading.stamp_ns)
            if before is not None:
                found = _step(before, frame)
                lost += found is None
                motion = motion if found is None else found
                poses.append(poses[-1] @ T_base @ motion @ invert_transform(T_base))
            before = frame
    return without_covariances(stamps, poses), lost


def without_covariances(stamps: list[int], poses: list[FloatArray]) -> Trajectory:
    """A trajectory that claims nothing."""
    estimates = [PoseEstimate(s, T, np.eye(6)) for s, T in zip(stamps, poses, strict=False)]
    return replace(Trajectory.from_estimates(estimates), covariances=None)


def _frame(reading: Reading, sensors: AgentSensors, mode: str) -> _Frame | None:
    if isinstance(reading, DepthReading) and mode == "tof" and sensors.tof is not None:
        grey = grey_picture(reading)
        keypoints, descriptors = cv2.SIFT_create(_FEATURES).detectAndCompute(grey, None)  # type: ignore[attr-defined]
        uv = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        camera, depth = sensors.tof.camera, depth_m(reading, sensors)
        found = depth[tuple(np.round(uv[:, ::-1]).astype(int).T)]
        return _Frame(uv, _at_least_none(descriptors), camera.unproject(uv, found), camera.K)
    if isinstance(reading, StereoReading) and mode == "stereo" and sensors.left and sensors.right:
        rectify = StereoRectifier(sensors.left, sensors.right)
        pair = rectify(reading.stamp_ns, reading.pair.left, reading.pair.right)
        return _Frame(*stereo_points(pair, _FEATURES), pair.stereo.camera.K)
    return None


def grey_picture(reading: DepthReading) -> AnyArray:
    """The picture beside a depth image, uint8 over its whole range; ValueError if there is none."""
    raw = reading.raw
    picture = raw.amplitude if raw.amplitude is not None else raw.intensity
    if picture is None:
        raise ValueError("the depth camera has no picture (amplitude or intensity)")
    if picture.dtype == np.uint8:
        return picture
    return np.asarray(cv2.normalize(picture.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX)).astype(np.uint8)  # type: ignore[call-overload]


def depth_m(reading: DepthReading, sensors: AgentSensors) -> FloatArray:
    """Depth (h, w) along z, m; NaN where there is none."""
    image = reading.raw.image
    depth = np.asarray(image, dtype=np.float64) * (1e-3 if image.dtype == np.uint16 else 1.0)
    if sensors.measurement == "range" and sensors.tof is not None:
        v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]].reshape(2, -1).astype(np.float64)
        rays = sensors.tof.camera.unproject(np.column_stack([u, v]), np.ones(u.size))
        depth = depth / np.linalg.norm(rays, axis=1).reshape(depth.shape)
    return np.where(depth > _NEAREST_M, depth, np.nan)


def stereo_points(pair: StereoImages, features: int = 3000) -> tuple[FloatArray, AnyArray, FloatArray]:
    """SIFT keypoints (n, 2) px of the left image, descriptors (n, 128), points (n, 3) in its optical frame."""
    sift, camera = cv2.SIFT_create(features), pair.stereo.camera  # type: ignore[attr-defined]
    (left, about_left), (right, about_right) = (sift.detectAndCompute(i, None) for i in (pair.left, pair.right))
    pairs = matches(_at_least_none(about_left), _at_least_none(about_right))
    sides = [np.array([k.pt for k in side], dtype=np.float64).reshape(-1, 2) for side in (left, right)]
    uv, partner = sides[0][pairs[:, 0]], sides[1][pairs[:, 1]]
    disparity = uv[:, 0] - partner[:, 0]
    good = (np.abs(uv[:, 1] - partner[:, 1]) < _MOST_ROWS_APART_PX) & (disparity > _LEAST_DISPARITY_PX)
    points = camera.unproject(uv[good], pair.stereo.depth_from_disparity(disparity[good]))
    return uv[good], _at_least_none(about_left)[pairs[good, 0]], points


def matches(a: AnyArray, b: AnyArray) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Pairs (k, 2) of descriptors that pass Lowe's ratio test."""
    found = cv2.BFMatcher().knnMatch(a, b, k=2) if len(a) and len(b) else []
    pairs = [(m[0].queryIdx, m[0].trainIdx) for m in found if len(m) == 2 and m[0].distance < _RATIO * m[1].distance]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _at_least_none(descriptors: AnyArray | None) -> AnyArray:
    return np.empty((0, 128), np.float32) if descriptors is None else descriptors


def _step(before: _Frame, now: _Frame) -> FloatArray | None:
    """T_before_now (4, 4) of the camera, or None."""
    pairs = matches(before.descriptors, now.descriptors)
    pairs = pairs[np.isfinite(before.points[pairs[:, 0]]).all(axis=1)]
    if len(pairs) < _LEAST_INLIERS:
        return None
    points, pixels = before.points[pairs[:, 0]], now.uv[pairs[:, 1]]
    cv2.setRNGSeed(0)
    ok, turn, shift, inliers = cv2.solvePnPRansac(points, pixels, now.K, None, None, None, False, 1000, 2.0, 0.999)  # type: ignore[call-overload]
    if not ok or inliers is None or len(inliers) < _LEAST_INLIERS:
        return None
    chosen = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], now.K, None, turn, shift)  # type: ignore[call-overload]
    if np.linalg.norm(shift) > _LARGEST_STEP_M:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return invert_transform(make_transform(rotation, np.asarray(shift, dtype=np.float64).ravel()))
