# SPDX-License-Identifier: Apache-2.0
"""Text submaps in the Linear SLAM format from simulated walks, 2D or 3D, so that sizes not at hand can be tried.

``ring``: laps along a ring with a wavy floor. ``park``: one step per map through a park with few trees, by ways that
cross. ``city``: a pose graph on a grid of streets, with loops where a crossing is met again. ``sphere``: a pose graph
along a spiral up a sphere, each turn tied to the one below. ``tumbling``: laps with any attitude from one map to the
next. ``sparse``: laps where a map sees 0 to 3 landmarks, most of them once. ``noise`` scales all standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import numpy as np
from submap_world import unit

from slam_core.geometry import euler_from_rotation, rotation_from_euler, so3_exp
from slam_experiments.linear_slam.text_maps import TextMap

SIGMA = {"position": 0.05, "angle": 0.02, "feature": 0.2}


def ring(count: int, dimension: int, seed: int = 0, noise: float = 1.0, features_seen: int = 8) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    radius, laps = max(5.0, count / 3.0 / (2 * np.pi)), 3.0
    angle = np.linspace(0.0, 2 * np.pi * laps, count + 1)
    centre = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), np.sin(7 * angle)], axis=1)[:, :dimension]
    R = np.array([_rotation(a, dimension) for a in angle])
    features = int(2 * np.pi * radius * 2)
    place, r = rng.uniform(0, 2 * np.pi, features), radius + rng.uniform(-4, 4, features)
    points = np.stack([r * np.sin(place), radius - r * np.cos(place), rng.uniform(-2, 2, features)], axis=1)
    points = points[:, :dimension]
    seen = [_nearest(points, centre[k] + R[k][:, 0] * 3.0, features_seen) for k in range(count)]
    return _walk(R, centre, points, seen, noise, rng)


def park(count: int, dimension: int, seed: int = 0, noise: float = 1.0, features: int = 150) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    goals, goal, extent = rng.uniform(-100, 100, (max(6, count // 120), 2)), 0, 110.0
    t, yaws = [np.zeros(2)], [0.0]
    while len(t) <= count:
        way = goals[goal % len(goals)] - t[-1]
        goal += int(np.linalg.norm(way) < 5.0 or len(t) % 400 == 0)
        turn = (np.arctan2(way[1], way[0]) - yaws[-1] + np.pi) % (2 * np.pi) - np.pi
        yaws.append(yaws[-1] + float(np.clip(turn, -0.08, 0.08)))
        t.append(t[-1] + 0.6 * np.array([np.cos(yaws[-1]), np.sin(yaws[-1])]))
    flat = np.array(t)
    centre = np.column_stack([flat, 3 * np.sin(flat[:, 0] / 20)])[:, :dimension]
    points = np.column_stack([rng.uniform(-extent, extent, (features, 2)), rng.uniform(-3, 6, features)])[:, :dimension]
    R = np.array([_rotation(yaw, dimension) for yaw in yaws])
    seen = []
    for k in range(count):
        local = (points - centre[k]) @ R[k]
        near = (np.linalg.norm(local, axis=1) < 40.0) & (local[:, 0] > 0.0) & (rng.random(features) < 0.8)
        seen.append(np.nonzero(near)[0])
    return _walk(R, centre, points, seen, noise, rng)


def city(count: int, seed: int = 0, noise: float = 1.0, extent: int = 20) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    heading, cells, headings = 0, [np.zeros(2, dtype=np.int64)], [0]
    while len(cells) <= count:
        heading = (heading + int(rng.choice([0, 0, 0, 1, -1]))) % 4
        step = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[heading]
        if np.abs(cells[-1] + step).max() <= extent:
            cells.append(cells[-1] + step)
            headings.append(heading)
    R = np.array([_rotation(h * np.pi / 2, 2) for h in headings])
    met: dict[bytes, int] = {}
    older = [met.setdefault(cell.tobytes(), k) for k, cell in enumerate(cells)]
    return _graph(R, np.array(cells, dtype=np.float64), [o if k % 2 and o < k - 1 else -1 for k, o in enumerate(older)],
                  noise, rng)  # fmt: skip


def sphere(count: int, seed: int = 0, noise: float = 1.0, turn: int = 50) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    k = np.arange(count + 1)
    height, angle = 0.45 * np.pi * (2.0 * k / count - 1.0), 2 * np.pi * k / turn
    up = np.column_stack([np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)])
    forward = np.gradient(up, axis=0)
    forward -= up * np.sum(forward * up, axis=1, keepdims=True)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    R = np.stack([forward, np.cross(up, forward), up], axis=2)
    return _graph(R, 50.0 * up, [i - turn if i >= turn else -1 for i in k.tolist()], noise, rng)


def tumbling(count: int, seed: int = 0, noise: float = 1.0, features_seen: int = 6) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    turns = so3_exp(rng.uniform(0.0, np.pi, (count, 1)) * unit(rng.normal(size=(count, 3))))
    R = np.array(list(accumulate(turns, np.matmul, initial=np.eye(3))))
    centre, points = _laps(count, 120, 3, rng)
    return _walk(R, centre, points, [_nearest(points, place, features_seen) for place in centre[:-1]], noise, rng)


def sparse(count: int, dimension: int, seed: int = 0, noise: float = 1.0) -> list[TextMap]:
    rng = np.random.default_rng(seed)
    centre, points = _laps(count, 3 * count, dimension, rng)
    R = np.array([_rotation(k / 20, dimension) for k in range(count + 1)])
    seen = [
        np.sort(rng.choice(_nearest(points, place, 20), rng.integers(0, 4), replace=False)) for place in centre[:-1]
    ]
    return _walk(R, centre, points, seen, noise, rng)


def _laps(count: int, features: int, dimension: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places along laps of a circle, and points around it."""
    angle = np.arange(count + 1) / 20
    centre = 10.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count + 1)])
    points = np.column_stack([rng.uniform(-13, 13, (features, 2)), rng.uniform(-3, 3, features)])
    return centre[:, :dimension], points[:, :dimension]


def _rotation(yaw: float, dimension: int) -> np.ndarray:
    full = rotation_from_euler(yaw, 0.1 * np.sin(3 * yaw), 0.05)
    return full if dimension == 3 else rotation_from_euler(yaw)[:2, :2]


def _nearest(points: np.ndarray, place: np.ndarray, count: int) -> np.ndarray:
    return np.sort(np.argsort(np.linalg.norm(points - place, axis=1))[:count])


def _walk(
    R: np.ndarray, t: np.ndarray, points: np.ndarray, seen: list[np.ndarray], noise: float, rng: np.random.Generator
) -> list[TextMap]:
    """A map per step: the next pose and what is ``seen``; ids of poses count down."""
    return [_local_map(-1, R, t, k, [k + 1], points, near, noise, rng) for k, near in enumerate(seen)]


def _graph(R: np.ndarray, t: np.ndarray, older: list[int], noise: float, rng: np.random.Generator) -> list[TextMap]:
    """A map per step: the next pose and, where it is not -1, one ``older`` pose; ids of poses count up."""
    none = np.empty(0, dtype=np.int64)
    poses = [[k + 1, *([older[k]] if older[k] >= 0 else [])] for k in range(len(t) - 1)]
    return [_local_map(1, R, t, k, seen, np.empty((0, t.shape[1])), none, noise, rng) for k, seen in enumerate(poses)]


def _local_map(
    sign: int, R: np.ndarray, t: np.ndarray, k: int, poses: list[int], points: np.ndarray, near: np.ndarray,
    noise: float, rng: np.random.Generator,
) -> TextMap:  # fmt: skip
    d = t.shape[1]
    values, sigma = [], []
    for j in poses:
        relative = R[k].T @ R[j]
        angles = euler_from_rotation(relative) if d == 3 else np.array([np.arctan2(relative[1, 0], relative[0, 0])])
        values += [R[k].T @ (t[j] - t[k]), angles]
        sigma += [SIGMA["position"]] * d + [SIGMA["angle"]] * len(angles)
    mean = np.concatenate([*values, ((points[near] - t[k]) @ R[k]).ravel()])
    deviation = noise * np.array(sigma + [SIGMA["feature"]] * (d * len(near)))
    mix = np.eye(len(mean)) + 0.1 * rng.normal(size=(len(mean),) * 2) / np.sqrt(len(mean))
    covariance = (mix * deviation**2) @ mix.T
    mean = mean + np.linalg.cholesky(covariance) @ rng.normal(size=len(mean))
    size = len(sigma) // len(poses)
    information = np.linalg.inv(covariance)
    return TextMap(
        sign * k,
        sign * np.array(poses),
        mean[: len(sigma)].reshape(-1, size),
        near + 1,
        mean[len(sigma) :].reshape(-1, d),
        0.5 * (information + information.T),
    )


SETS: dict[str, Callable[[int, float], list[TextMap]]] = {
    "ring 700, 2D": lambda seed, noise: ring(700, 2, seed, noise),
    "ring 870, 3D": lambda seed, noise: ring(870, 3, seed, noise),
    "park 6898, 2D": lambda seed, noise: park(6898, 2, seed, noise),
    "park 6898, 2D, noise x 2": lambda seed, noise: park(6898, 2, seed, 2.0 * noise),
    "park 870, 3D, noise x 2": lambda seed, noise: park(870, 3, seed, 2.0 * noise),
    "city 3500, pose graph": lambda seed, noise: city(3500, seed, noise),
    "city 3500, pose graph, noise x 3": lambda seed, noise: city(3500, seed, 3.0 * noise),
    "city 10000, pose graph": lambda seed, noise: city(10000, seed, noise, extent=50),
    "sphere 2500, pose graph": lambda seed, noise: sphere(2500, seed, noise),
    "sphere 2500, pose graph, noise x 2": lambda seed, noise: sphere(2500, seed, 2.0 * noise),
    "tumbling 500, 3D, noise x 3": lambda seed, noise: tumbling(500, seed, 3.0 * noise),
    "sparse 500, 2D": lambda seed, noise: sparse(500, 2, seed, noise),
}
"""Sets of the sizes that Linear SLAM was published with, and two that are hard, by name; with a seed and the noise as a
share of the set's own.
"""


def write(maps: list[TextMap], folder: Path) -> None:
    """The files a reader of the format expects."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, m in enumerate(maps):
        ids = np.concatenate([np.repeat(m.pose_ids, m.poses.shape[1]), np.repeat(m.feature_ids, m.features.shape[1])])
        values = np.concatenate([m.poses.ravel(), m.features.ravel()])
        lines = [str(abs(m.reference)), str(len(values)), *(f"{i} {v:.17g}" for i, v in zip(ids, values, strict=True))]
        lines += [" ".join(f"{v:.17g}" for v in row) for row in m.information]
        (folder / f"localmap_{k + 1}.txt").write_text("\n".join(lines) + "\n")
