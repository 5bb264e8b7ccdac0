# SPDX-License-Identifier: Apache-2.0
"""A world of landmarks and the submaps a consistent EKF would build in it: exact Gaussians, to judge joining by.

Every submap is the posterior of a small estimation problem of its own: a few rig poses with odometry between them,
landmarks seen from each with a stereo camera's noise. Its error is one draw from that posterior's covariance, so that
NEES tests are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sjsam_node.loop_closure.association import PointSet
from slam_core.geometry import (
    FloatArray,
    boxplus,
    compose_jacobians,
    inverse_jacobian,
    invert_transform,
    make_transform,
    rotation_from_euler,
    skew,
    transform_points,
)
from slam_core.types import PoseEstimate, Submap


@dataclass(frozen=True)
class World:
    """Landmark positions (n, 3) m and their true descriptors (n, 128), unit norm."""

    points: FloatArray
    descriptors: FloatArray

    @classmethod
    def random(cls, points: FloatArray, rng: np.random.Generator) -> World:
        return cls(points, unit(rng.normal(size=(len(points), 128))))


@dataclass(frozen=True)
class Sensor:
    """Stereo-like: seen in front within range and field of view; noise grows with the square of the distance."""

    max_range: float = 5.0
    half_fov: float = 0.85
    sigma_bearing: float = 0.003
    sigma_depth: float = 0.004  # per square metre of distance
    odometry: tuple[float, float] = (0.02, 0.005)  # m, rad per step
    descriptor_noise: float = 0.04  # per element: similarity of two sightings about 0.83
    detection: float = 0.9
    max_landmarks: int = 60


@dataclass
class Agent:
    """Walks a path and emits submaps; keeps ids of landmarks it carries from one submap to the next."""

    world: World
    path: list[FloatArray]
    rng: np.random.Generator
    name: str = ""
    sensor: Sensor = field(default_factory=Sensor)
    steps: int = 4
    stamp_ns: int = 0
    seen: list[np.ndarray] = field(default_factory=list)  # world index of every submap's landmarks
    _ids: dict[int, int] = field(default_factory=dict)
    _next_id: int = 0

    def submaps(self) -> list[Submap]:
        count = (len(self.path) - 1) // self.steps
        return [self._submap(k) for k in range(count)]

    def true_start(self, index: int) -> FloatArray:
        return self.path[index * self.steps]

    def _submap(self, index: int) -> Submap:
        poses = self.path[index * self.steps : (index + 1) * self.steps + 1]
        T_start = poses[0]
        local = [invert_transform(T_start) @ T for T in poses]
        seen, visible = self._visible(poses)
        self.seen.append(seen)
        points = (self.world.points[seen] - T_start[:3, 3]) @ T_start[:3, :3]
        covariance = self._posterior(local, points, visible)
        error = np.linalg.cholesky(covariance) @ self.rng.normal(size=len(covariance))
        n_path = len(local) - 1
        estimates = [T if k == 0 else boxplus(T, error[6 * k - 6 : 6 * k]) for k, T in enumerate(local)]
        blocks = [np.zeros((6, 6))] + [covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n_path)]
        blocks[0] = 1e-12 * np.eye(6)
        stamps = [self.stamp_ns + int((index * self.steps + k) * 1e8) for k in range(len(local))]
        return Submap(
            agent=self.name,
            index=index,
            start_stamp_ns=stamps[0],
            end_stamp_ns=stamps[-1],
            end_pose=estimates[-1],
            landmarks=points + error[6 * n_path :].reshape(-1, 3),
            covariance=covariance[6 * n_path - 6 :, 6 * n_path - 6 :],
            landmark_ids=self._carry_ids(seen),
            sightings=visible.sum(axis=0).astype(np.int32),
            descriptors=self._descriptors(seen),
            path=tuple(PoseEstimate(s, T, P) for s, T, P in zip(stamps, estimates, blocks, strict=True)),
        )

    def _visible(self, poses: Sequence[FloatArray]) -> tuple[np.ndarray, np.ndarray]:
        """World indices of the submap's landmarks, and which pose sees which, (poses, n)."""
        masks = []
        for T in poses:
            p = (self.world.points - T[:3, 3]) @ T[:3, :3]
            distance = np.linalg.norm(p, axis=1)
            inside = (np.arctan2(np.abs(p[:, 1]), p[:, 0]) < self.sensor.half_fov) & (distance < self.sensor.max_range)
            masks.append(inside & (distance > 0.3) & (self.rng.random(len(p)) < self.sensor.detection))
        mask = np.array(masks)
        seen = np.nonzero(mask.sum(axis=0) >= 2)[0]
        if len(seen) > self.sensor.max_landmarks:
            seen = np.sort(self.rng.choice(seen, self.sensor.max_landmarks, replace=False))
        return seen, mask[:, seen]

    def _carry_ids(self, seen: np.ndarray) -> np.ndarray:
        carried = {}
        for landmark in seen.tolist():
            if landmark in self._ids:
                carried[landmark] = self._ids[landmark]
            else:
                carried[landmark] = self._next_id
                self._next_id += 1
        self._ids = carried
        return np.array([carried[i] for i in seen.tolist()], dtype=np.int64)

    def _descriptors(self, seen: np.ndarray) -> np.ndarray:
        noise = self.sensor.descriptor_noise * self.rng.normal(size=(len(seen), 128))
        return unit(self.world.descriptors[seen] + noise).astype(np.float32)

    def _posterior(self, poses: list[FloatArray], points: FloatArray, visible: np.ndarray) -> FloatArray:
        """Covariance of (poses after the first, landmarks) given odometry and sightings, linearised at the truth."""
        n_path, n = len(poses) - 1, len(points)
        information = np.zeros((6 * n_path + 3 * n,) * 2)
        sigma = np.repeat(self.sensor.odometry, 3)
        for k in range(n_path):
            T_inverse = invert_transform(poses[k])
            J_a, J_b = compose_jacobians(T_inverse, poses[k + 1])
            J = np.zeros((6, len(information)))
            if k:
                J[:, 6 * k - 6 : 6 * k] = J_a @ inverse_jacobian(poses[k])
            J[:, 6 * k : 6 * k + 6] = J_b
            information += J.T @ (J / sigma[:, None] ** 2)
        for k, T in enumerate(poses):
            for i in np.nonzero(visible[k])[0]:
                self._add_sighting(information, k, T, points[i], slice(6 * n_path + 3 * i, 6 * n_path + 3 * i + 3))
        covariance = np.linalg.inv(information)
        return 0.5 * (covariance + covariance.T)

    def _add_sighting(self, information: FloatArray, k: int, T: FloatArray, point: FloatArray, at: slice) -> None:
        R = T[:3, :3]
        local = R.T @ (point - T[:3, 3])
        distance = float(np.linalg.norm(local))
        ray = local / distance
        noise = (self.sensor.sigma_bearing * distance) ** 2 * (np.eye(3) - np.outer(ray, ray))
        noise += (self.sensor.sigma_depth * distance**2 + 0.001) ** 2 * np.outer(ray, ray)
        weight = np.linalg.inv(noise)
        information[at, at] += R @ weight @ R.T
        if k:
            J = np.concatenate([-R.T, R.T @ skew(point - T[:3, 3])], axis=1)
            pose = slice(6 * k - 6, 6 * k)
            information[pose, pose] += J.T @ weight @ J
            cross = J.T @ weight @ R.T
            information[pose, at] += cross
            information[at, pose] += cross.T


def two_views(
    rng: np.random.Generator, n: int = 25, sigma: float = 0.03
) -> tuple[PointSet, PointSet, np.ndarray, np.ndarray]:
    """The same landmarks in two frames with correlated noise, their descriptors noisy; T_first_second, true pairs."""
    T = boxplus(np.eye(4), np.array([1.0, -0.5, 0.2, 0.1, -0.2, 0.7]))
    points, order = rng.uniform(-3, 3, (n, 3)), rng.permutation(n)
    looks = unit(rng.normal(size=(n, 128)))
    sets = []
    for frame, index in ((points, np.arange(n)), (transform_points(np.linalg.inv(T), points), order)):
        root = sigma * (np.eye(3 * n) + 0.3 * rng.normal(size=(3 * n, 3 * n)) / np.sqrt(3 * n))
        P = root @ root.T
        seen = frame[index] + (root @ rng.normal(size=3 * n)).reshape(-1, 3)
        descriptors = unit(looks[index] + 0.04 * rng.normal(size=(n, 128))).astype(np.float32)
        sets.append(PointSet(seen, P, descriptors))
    return sets[0], sets[1], T, np.stack([order, np.arange(n)], axis=1)


def unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def pose(x: float, y: float, yaw: float) -> FloatArray:
    return make_transform(rotation_from_euler(yaw), np.array([x, y, 0.0]))


def path_through(corners: Sequence[tuple[float, float]], step: float = 0.25, turn: float = 0.3) -> list[FloatArray]:
    """Poses along a polyline, ``step`` m apart, turning on the spot at the corners by at most ``turn`` rad each."""
    poses: list[FloatArray] = []
    yaw = None
    for (x0, y0), (x1, y1) in pairwise(corners):
        heading = float(np.arctan2(y1 - y0, x1 - x0))
        if yaw is not None:
            change = (heading - yaw + np.pi) % (2 * np.pi) - np.pi
            count = int(np.ceil(abs(change) / turn))
            poses += [pose(x0, y0, yaw + change * k / count) for k in range(1, count)]
        length = float(np.hypot(x1 - x0, y1 - y0))
        count = max(1, round(length / step))
        poses += [pose(x0 + (x1 - x0) * k / count, y0 + (y1 - y0) * k / count, heading) for k in range(count)]
        yaw = heading
    return poses


def circle(radius: float, turns: float = 1.0, step: float = 0.25) -> list[FloatArray]:
    count = round(2 * np.pi * radius * turns / step)
    angles = np.linspace(0.0, 2 * np.pi * turns, count + 1)
    return [pose(radius * np.sin(a), radius * (1 - np.cos(a)), a) for a in angles]


def ring_world(radius: float, rng: np.random.Generator, density: float = 8.0) -> World:
    """Landmarks on two round walls either side of a circle that starts at the origin along x."""
    count = int(2 * np.pi * radius * density)
    angle = rng.uniform(0, 2 * np.pi, count)
    r = radius + rng.choice([-2.0, 2.0], count) + rng.normal(0, 0.1, count)
    points = np.stack([r * np.sin(angle), radius - r * np.cos(angle), rng.uniform(-1.0, 1.5, count)], axis=1)
    return World.random(points, rng)


def room(centre: tuple[float, float], size: tuple[float, float], count: int, rng: np.random.Generator) -> FloatArray:
    """Landmarks on the four walls of a room."""
    side = rng.integers(0, 4, count)
    u = rng.uniform(-0.5, 0.5, count)
    xy = np.where(
        (side % 2 == 0)[:, None], np.stack([u, side * 0.5 - 0.5], 1), np.stack([side - 2.0, u], 1) * [0.5, 1.0]
    )
    xy = np.where((side % 2 == 1)[:, None], np.stack([(side - 2.0) * 0.5, u], 1), xy)
    xy = np.where((side % 2 == 0)[:, None], np.stack([u, (side - 1.0) * 0.5], 1), xy)
    return np.concatenate([xy * size + np.array(centre), rng.uniform(-1.0, 1.5, (count, 1))], axis=1)


Path = Callable[[], list[FloatArray]]
