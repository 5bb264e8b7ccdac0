# SPDX-License-Identifier: Apache-2.0
"""A world of points with descriptors, seen by a stereo camera as features: the measurement model of the filter and its
noise.

Used by the tests and the consistency benchmark, where the truth must be exactly what the filter assumes, or wrong in a
way that is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import (
    OPTICAL_FROM_RIG,
    FloatArray,
    invert_transform,
    make_transform,
    rotation_from_euler,
    so3_exp,
    transform_points,
)
from slam_core.types import Features

CAMERA = Camera(640, 480, 283.0, 283.0, 320.0, 240.0)
BASELINE = 0.12
SIGMA_PX = 0.6
SIGMA_DISPARITY = 0.4
T_RIG_OPTICAL = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))


@dataclass(frozen=True, eq=False)
class PointWorld:
    """Points (n, 3) in the world frame with unit descriptors (n, 64), seen from no farther than ``reach`` (m)."""

    points: FloatArray
    descriptors: np.ndarray
    reach: float = np.inf

    def features(
        self, T_world_rig: FloatArray, stamp_ns: int, rng: np.random.Generator, *, detection: float = 0.8,
        max_features: int = 200, noise: float = 1.0,
    ) -> tuple[Features, np.ndarray]:  # fmt: skip
        """What a rig at a pose sees, and which points these are (n,). ``noise`` scales the true noise, not the
        claimed.
        """
        optical = transform_points(invert_transform(T_world_rig @ T_RIG_OPTICAL), self.points)
        uv = CAMERA.project(np.where(optical[:, 2:] > 0.3, optical, [0, 0, -1.0]))
        with np.errstate(invalid="ignore"):
            visible = (uv[:, 0] > 0) & (uv[:, 0] < CAMERA.width) & (uv[:, 1] > 0) & (uv[:, 1] < CAMERA.height)
        visible &= (optical[:, 2] < self.reach) & (rng.random(len(uv)) < detection)
        index = np.flatnonzero(visible)
        index = rng.permutation(index)[:max_features]
        return self._measured(index, uv[index], optical[index, 2], stamp_ns, rng, noise), index

    def _measured(
        self,
        index: np.ndarray,
        uv: FloatArray,
        depth: FloatArray,
        stamp_ns: int,
        rng: np.random.Generator,
        noise: float,
    ) -> Features:
        n = len(index)
        fb = CAMERA.fx * BASELINE
        disparity = np.maximum(fb / depth + noise * SIGMA_DISPARITY * rng.standard_normal(n), 0.2)
        depth = fb / disparity
        uv = uv + noise * SIGMA_PX * rng.standard_normal((n, 2))
        descriptors = self.descriptors[index] + 0.04 * rng.standard_normal((n, self.descriptors.shape[1]))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        f32 = np.float32
        return Features(
            stamp_ns=stamp_ns, xyz=CAMERA.unproject(uv, depth).astype(f32), uv=uv.astype(f32), depth=depth.astype(f32),
            sigma_uv=np.full((n, 2), SIGMA_PX, dtype=f32), sigma_depth=(depth**2 / fb * SIGMA_DISPARITY).astype(f32),
            response=rng.random(n).astype(f32), source=np.zeros(n, dtype=np.uint8), descriptors=descriptors.astype(f32),
            camera=CAMERA,
        )  # fmt: skip


def room(
    rng: np.random.Generator, amount: int = 1200, size: tuple[float, float, float] = (8.0, 6.0, 3.0)
) -> PointWorld:
    """Points on the walls, floor and ceiling of a room around the origin, floor at z = -1.2 m."""
    half = 0.5 * np.array(size)
    points = rng.uniform(-half, half, (amount, 3))
    axis = rng.choice(3, amount, p=[0.4, 0.4, 0.2])
    points[np.arange(amount), axis] = half[axis] * rng.choice([-1.0, 1.0], amount)
    points[:, 2] += half[2] - 1.2
    descriptors = rng.standard_normal((amount, 64))
    return PointWorld(points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def two_rooms(rng: np.random.Generator) -> PointWorld:
    """Two rooms, centres 9 m apart along x; from one, little is seen of the other."""
    near, far = room(rng), room(rng)
    points = np.concatenate([near.points, far.points + np.array([9.0, 0.0, 0.0])])
    return PointWorld(points, np.concatenate([near.descriptors, far.descriptors]), reach=6.0)


def tour_of_two_rooms(steps: int = 150, handheld: float = 0.02, rate: float = 10.0) -> list[FloatArray]:
    """Poses T_world_rig along a figure of eight through both rooms and back to the start, 27 m, looking ahead."""
    poses = []
    for k in range(steps):
        angle = 2.0 * np.pi * k / (steps - 1)
        place = np.array([4.5 - 5.5 * np.cos(angle), 1.6 * np.sin(2.0 * angle), 0.0])
        ahead = np.array([5.5 * np.sin(angle), 3.2 * np.cos(2.0 * angle)])
        sway = handheld * np.array([np.sin(5.1 * k / rate), np.cos(6.3 * k / rate), np.sin(9.7 * k / rate)])
        tilt = 2.0 * handheld * np.array([np.sin(4.3 * k / rate), np.sin(7.1 * k / rate), 0.0])
        heading = float(np.arctan2(ahead[1], ahead[0]))
        poses.append(make_transform(rotation_from_euler(heading) @ so3_exp(tilt), place + sway))
    return poses


def loop(
    steps: int, rate: float = 10.0, radius: float = 1.5, turns: float = 1.0, handheld: float = 0.0
) -> list[FloatArray]:
    """Poses T_world_rig along a circle, looking outwards; ``handheld`` adds sway (m) and tilt (rad) of a walking
    person.
    """
    poses = []
    for k in range(steps):
        angle = 2.0 * np.pi * turns * k / max(steps - 1, 1)
        s = k / rate
        sway = handheld * np.array([np.sin(5.1 * s), np.cos(6.3 * s), np.sin(9.7 * s)])
        tilt = 2.0 * handheld * np.array([np.sin(4.3 * s), np.sin(7.1 * s + 1), np.sin(5.7 * s + 2)])
        t = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        poses.append(make_transform(rotation_from_euler(angle + 0.3) @ so3_exp(tilt), t + sway))
    return poses


def wander(
    steps: int, dt: float, sigma: FloatArray, velocity_sigma: FloatArray, rng: np.random.Generator, reach: float = 1.5
) -> list[FloatArray]:
    """Poses T_world_rig that follow the filter's own motion model within ``reach`` (m) of the origin.

    Random accelerations (6,) and a random first velocity; a walk that leaves the reach is drawn again.
    """
    while True:
        T, velocity = np.eye(4), velocity_sigma * rng.standard_normal(6)
        poses = [T]
        for _ in range(steps - 1):
            a = sigma * rng.standard_normal(6)
            step = velocity * dt + 0.5 * a * dt * dt
            T = T @ make_transform(so3_exp(step[3:]), step[:3])
            velocity = velocity + a * dt
            poses.append(T)
        if max(np.linalg.norm(pose[:3, 3]) for pose in poses) < reach:
            return poses
