# SPDX-License-Identifier: Apache-2.0
"""The two models of the filter: how the rig moves, how it sees a landmark, each with its Jacobians.

Core state of the rig, 12 error coordinates: position and rotation in the map frame (error of ``slam_core.geometry``),
then linear and angular velocity in the rig frame. Body velocities stay what they are while the rig turns, and when a
new submap starts.

A measurement is ``z = (u, v, 1/d)``: stereo noise is Gaussian in disparity, that is in inverse depth, not in depth;
for a ToF depth, whose sigma is small against d, both are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ekf_slam_node.filtering.measurement_kernels import LEAST_DEPTH, measured, observed, placed
from slam_core.camera import MIN_DEPTH, Camera
from slam_core.geometry import FloatArray, make_transform, skew, so3_exp, so3_left_jacobian, so3_log
from slam_core.types import Features

CORE_DIM = 12
"""Error coordinates of the rig: position 3, rotation 3, linear and angular velocity 3 + 3."""


_LONGEST_STEP_S = 10.0
"""A gap counts as no longer than this: the model says nothing about it any more, and larger variances cost digits."""


def seconds_between(start_stamp_ns: int, end_stamp_ns: int) -> float:
    """Time step of the motion model, s; long gaps count as :data:`_LONGEST_STEP_S`."""
    return min((end_stamp_ns - start_stamp_ns) * 1e-9, _LONGEST_STEP_S)


# ---- motion
def relative_motion(velocity: FloatArray, dt: float) -> FloatArray:
    """``T_previous_now`` (4, 4) of body velocities (6,), m/s and rad/s, held for dt (s)."""
    return make_transform(so3_exp(velocity[3:] * dt), velocity[:3] * dt)


def velocity_of_motion(T_previous_now: FloatArray, dt: float) -> FloatArray:
    """Body velocities (6,) that make a motion within dt: inverse of :func:`relative_motion`."""
    return np.concatenate([T_previous_now[:3, 3], so3_log(T_previous_now[:3, :3])]) / dt


def motion_jacobian(T_map_rig: FloatArray, velocity: FloatArray, dt: float) -> FloatArray:
    """Transition matrix F (12, 12) of the core state over dt, at the pose before the motion (Eq. 5.6)."""
    F = np.eye(CORE_DIM)
    R = T_map_rig[:3, :3]
    F[:3, 3:6] = -skew(R @ velocity[:3]) * dt
    F[:6, 6:] = increment_jacobian(R, velocity, dt) * dt
    return F


def increment_jacobian(rotation: FloatArray, velocity: FloatArray, dt: float) -> FloatArray:
    """Derivative (6, 6) of the pose with respect to the increment (translation, rotation vector) in the rig frame."""
    J = np.zeros((6, 6))
    J[:3, :3] = rotation
    J[3:, 3:] = rotation @ so3_left_jacobian(velocity[3:] * dt)
    return J


def noise_gain(rotation: FloatArray, velocity: FloatArray, dt: float) -> FloatArray:
    """G (12, 6): how accelerations, constant over dt and in the rig frame, enter the core state (Eq. 5.6)."""
    return np.vstack([increment_jacobian(rotation, velocity, dt) * (0.5 * dt * dt), np.eye(6) * dt])


# ---- measurement
@dataclass(frozen=True, eq=False)
class FrameCamera:
    """One of several cameras of a frame: its number on the rig, and its mounting.

    T_first_own: (4, 4) its optical frame in that of the camera whose mounting the filter calls T_rig_optical.
    """

    camera: Camera
    T_first_own: FloatArray
    number: int


class CameraPart(NamedTuple):
    """One camera's part of a frame: the measurements ``rows``, their camera and its mounting (4, 4) on the rig."""

    rows: slice | np.ndarray
    camera: Camera
    T_rig_optical: FloatArray


@dataclass(frozen=True, eq=False)
class Frame:
    """The usable features of one instant as measurements.

    z: (n, 3) u px, v px, inverse depth 1/m. variance: (n, 3) of z. descriptors: (n, d) float32, unit norm. index: (n,)
    into the features they came from. tracks: (n,) of the front end, 0 without one. Of a rig with several cameras:
    ``cameras`` that took part, with or without features, and ``seen_by`` (n,), which of them each measurement is of;
    ``camera`` is the first of them. Both are empty or zero for one camera alone.
    """

    stamp_ns: int
    z: FloatArray
    variance: FloatArray
    descriptors: np.ndarray
    camera: Camera
    index: np.ndarray
    tracks: np.ndarray
    cameras: tuple[FrameCamera, ...] = ()
    seen_by: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        if len(self.seen_by) != len(self.z):
            object.__setattr__(self, "seen_by", np.zeros(len(self.z), np.uint8))

    def __len__(self) -> int:
        return len(self.z)

    def parts(self, T_rig_optical: FloatArray) -> list[CameraPart]:
        """The frame camera by camera; ``T_rig_optical`` (4, 4) is the mounting of the rig's first camera."""
        if not self.cameras:
            return [CameraPart(slice(None), self.camera, T_rig_optical)]
        return [
            CameraPart(np.flatnonzero(self.seen_by == k), own.camera, T_rig_optical @ own.T_first_own)
            for k, own in enumerate(self.cameras)
        ]

    @property
    def camera_numbers(self) -> tuple[int, ...]:
        """Numbers on the rig of the cameras that took part; 0 is one alone."""
        return tuple(camera.number for camera in self.cameras) or (0,)

    def side_by_side(self, gap: float = 0.0) -> FloatArray:
        """Pixels (n, 2) in one wide image with the cameras' own beside each other, ``gap`` image widths between.

        Each image is as large in it as that of ``camera``.
        """
        if not self.cameras:
            return self.z[:, :2]
        first = self.camera
        scale = np.array([[first.width / c.camera.width, first.height / c.camera.height] for c in self.cameras])
        pixels = self.z[:, :2] * scale[self.seen_by]
        pixels[:, 0] += self.seen_by * (1.0 + gap) * first.width
        return np.asarray(pixels)

    @property
    def wide_size(self) -> tuple[int, int]:
        """Width and height (px) of the image of :meth:`side_by_side`."""
        return self.camera.width * max(1, len(self.cameras)), self.camera.height

    def with_larger_noise(self, factor: FloatArray) -> Frame:
        """Copy of the measurements with their variances multiplied by (3,)."""
        return replace(self, variance=self.variance * factor)

    def select(self, index: np.ndarray) -> Frame:
        """The measurements at ``index``."""
        return Frame(
            self.stamp_ns, self.z[index], self.variance[index], self.descriptors[index], self.camera, self.index[index],
            self.tracks[index], self.cameras, self.seen_by[index],
        )  # fmt: skip

    def places(self, index: np.ndarray) -> Frame:
        """The measurements at ``index`` without their descriptors, which are the larger part."""
        z, variance, own, tracks = self.z[index], self.variance[index], self.index[index], self.tracks[index]
        none = self.descriptors[:0]
        return Frame(self.stamp_ns, z, variance, none, self.camera, own, tracks, self.cameras, self.seen_by[index])


def frame_from_features(features: Features, usable: np.ndarray, min_sigma_px: float, min_sigma_depth: float) -> Frame:
    """Measurements of the features at ``usable`` (indices), with floors on their noise."""
    z, variance = np.empty((len(usable), 3)), np.empty((len(usable), 3))
    measured(
        features.uv, features.depth, features.sigma_uv, features.sigma_depth, usable, min_sigma_px, min_sigma_depth,
        z, variance,
    )  # fmt: skip
    descriptors, tracks = features.descriptors[usable], features.track_ids[usable]
    seen_by = features.seen_by[usable]
    return Frame(features.stamp_ns, z, variance, descriptors, features.camera, usable, tracks, (), seen_by)


def project(points: FloatArray, camera: Camera) -> FloatArray:
    """Measurements (n, 3) of points (n, 3) in the optical frame.

    Depths are kept away from zero, see the visibility test.
    """
    w = 1.0 / _safe_depth(points[:, 2])
    return np.column_stack([camera.fx * points[:, 0] * w + camera.cx, camera.fy * points[:, 1] * w + camera.cy, w])


def project_jacobian(points: FloatArray, camera: Camera) -> FloatArray:
    """Derivative (n, 3, 3) of :func:`project`."""
    w = 1.0 / _safe_depth(points[:, 2])
    J = np.zeros((len(points), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx * w, -camera.fx * points[:, 0] * w * w
    J[:, 1, 1], J[:, 1, 2] = camera.fy * w, -camera.fy * points[:, 1] * w * w
    J[:, 2, 2] = -w * w
    return J


def _safe_depth(depth: FloatArray) -> FloatArray:
    return np.maximum(depth, LEAST_DEPTH)


def back_project(z: FloatArray, camera: Camera) -> FloatArray:
    """Points (n, 3) in the optical frame of measurements (n, 3) (the inverse measurement, Eq. 6.22)."""
    depth = 1.0 / z[:, 2]
    x, y = (z[:, 0] - camera.cx) / camera.fx, (z[:, 1] - camera.cy) / camera.fy
    return np.column_stack([x * depth, y * depth, depth])


def rig_points(frame: Frame, T_rig_optical: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 3) of a frame's features in the rig frame and their covariances (n, 3, 3) (Eqs. 6.22, 6.24)."""
    points, covariances = np.empty((len(frame), 3)), np.empty((len(frame), 3, 3))
    for index, camera, T in frame.parts(T_rig_optical):
        own, spread = points[index], covariances[index]
        placed(frame.z[index], frame.variance[index], T, camera.lens, own, spread)
        points[index], covariances[index] = own, spread
    return points, covariances


def observe(T_parent_rig: FloatArray, T_rig_optical: FloatArray, points: FloatArray, camera: Camera) -> Observation:
    """Predicted measurements, by a rig at ``T_parent_rig``, of points (n, 3) in the parent frame."""
    n = len(points)
    seen = Observation(np.empty((n, 3)), np.empty(n), np.empty((n, 3, 6)), np.empty((n, 3, 3)))
    T, centre = T_parent_rig @ T_rig_optical, T_parent_rig[:3, 3]
    observed(points, T, centre, camera.lens, seen.z, seen.depth, seen.J_pose, seen.J_point)
    return seen


@dataclass(frozen=True, eq=False)
class Observation:
    """Predicted measurements (n, 3), depths (n,) m, and Jacobians.

    The Jacobians are with respect to the rig's pose (n, 3, 6) and the points (n, 3, 3).
    """

    z: FloatArray
    depth: FloatArray
    J_pose: FloatArray
    J_point: FloatArray

    def select(self, index: np.ndarray) -> Observation:
        """The observations at ``index``."""
        return Observation(self.z[index], self.depth[index], self.J_pose[index], self.J_point[index])

    def in_image(self, camera: Camera, margin_px: float = 0.0) -> np.ndarray:
        """Mask of the points in front of the camera and inside the image, by more than the margin."""
        u, v = self.z[:, 0], self.z[:, 1]
        inside = (
            (u >= margin_px)
            & (u <= camera.width - 1 - margin_px)
            & (v >= margin_px)
            & (v <= camera.height - 1 - margin_px)
        )
        return np.asarray(inside & (self.depth > MIN_DEPTH))
