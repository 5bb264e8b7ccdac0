"""Text submaps in the Linear SLAM format from a simulated walk, 2D or 3D, so that sizes not at hand can be tried."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sjsam_node.linear_slam_text import TextMap
from slam_core.geometry import euler_from_rotation, rotation_from_euler


def simulate(count: int, dimension: int, seed: int = 0, features_seen: int = 8, laps: float = 3.0) -> list[TextMap]:
    """``count`` local maps of one step each along a ring with a wavy floor, ``features_seen`` features in each."""
    rng = np.random.default_rng(seed)
    radius = max(5.0, count / laps / (2 * np.pi))
    angle = np.linspace(0.0, 2 * np.pi * laps, count + 1)
    centre = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), np.sin(7 * angle)], axis=1)[:, :dimension]
    rotations = np.array([_rotation(a, dimension) for a in angle])
    features = int(2 * np.pi * radius * 2)
    place = rng.uniform(0, 2 * np.pi, features)
    r = radius + rng.uniform(-4, 4, features)
    points = np.stack([r * np.sin(place), radius - r * np.cos(place), rng.uniform(-2, 2, features)], axis=1)[
        :, :dimension
    ]
    return [_local_map(k, centre, rotations, points, features_seen, rng) for k in range(count)]


def _rotation(yaw: float, dimension: int) -> np.ndarray:
    full = rotation_from_euler(yaw, 0.1 * np.sin(3 * yaw), 0.05)
    return full if dimension == 3 else rotation_from_euler(yaw)[:2, :2]


def _local_map(
    k: int, t: np.ndarray, R: np.ndarray, points: np.ndarray, count: int, rng: np.random.Generator
) -> TextMap:
    d = t.shape[1]
    near = np.sort(np.argsort(np.linalg.norm(points - t[k] - R[k][:, 0] * 3.0, axis=1))[:count])
    relative = R[k].T @ R[k + 1]
    angles = euler_from_rotation(relative) if d == 3 else np.array([np.arctan2(relative[1, 0], relative[0, 0])])
    mean = np.concatenate([R[k].T @ (t[k + 1] - t[k]), angles, ((points[near] - t[k]) @ R[k]).ravel()])
    sigma = np.concatenate([np.full(d, 0.05), np.full(len(angles), 0.01), np.full(d * count, 0.1)])
    mix = np.eye(len(mean)) + 0.1 * rng.normal(size=(len(mean),) * 2) / np.sqrt(len(mean))
    covariance = (mix * sigma**2) @ mix.T
    mean = mean + np.linalg.cholesky(covariance) @ rng.normal(size=len(mean))
    size = d + len(angles)
    information = np.linalg.inv(covariance)
    return TextMap(
        -k, np.array([-k - 1]), mean[:size].reshape(1, -1), near + 1, mean[size:].reshape(-1, d),
        0.5 * (information + information.T),
    )  # fmt: skip


def write(maps: list[TextMap], folder: Path) -> None:
    """The files a reader of the format expects."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, m in enumerate(maps):
        ids = np.concatenate([np.repeat(m.pose_ids, m.poses.shape[1]), np.repeat(m.feature_ids, m.features.shape[1])])
        values = np.concatenate([m.poses.ravel(), m.features.ravel()])
        lines = [str(abs(m.reference)), str(len(values)), *(f"{i} {v:.17g}" for i, v in zip(ids, values, strict=True))]
        lines += [" ".join(f"{v:.17g}" for v in row) for row in m.information]
        (folder / f"localmap_{k + 1}.txt").write_text("\n".join(lines) + "\n")
