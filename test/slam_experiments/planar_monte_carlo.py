# SPDX-License-Identifier: Apache-2.0
"""The 2D experiment of the thesis (1.7, 5.1): a robot drives a loop among landmarks, 50 samples."""

from __future__ import annotations

import numpy as np

from slam_core.evaluation import nees
from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf, move, range_bearing, wrap

MOTION_COVARIANCE = np.diag([0.02, 0.01, 0.01]) ** 2
ROUGH_COVARIANCE = np.diag([0.1, 0.05, 0.05]) ** 2


def scattered(rng: np.random.Generator, amount: int, spacing: float = 0.8) -> FloatArray:
    """Landmarks (n, 2) around the loop, no two closer than ``spacing``: closer ones no association could tell apart."""
    points = np.zeros((0, 2))
    while len(points) < amount:
        point = rng.uniform(-6.0, 6.0, 2) + np.array([0.0, 3.0])
        if not len(points) or np.linalg.norm(points - point, axis=1).min() > spacing:
            points = np.vstack([points, point])
    return points


def drive(
    rng: np.random.Generator,
    config: PlanarConfig,
    steps: int = 50,
    reach: float = 6.0,
    landmarks: int = 40,
    rounds: int = 1,
    covariance: FloatArray = MOTION_COVARIANCE,
) -> tuple[list[FloatArray], list[FloatArray], FloatArray, list[np.ndarray], list[FloatArray]]:
    """Truth (steps, 3), noisy motions, landmarks (n, 2), their indices seen at each step, and the measurements."""
    world = scattered(rng, landmarks)
    truth, motions, seen, measured = [np.zeros(3)], [], [], []
    for k in range(steps):
        if k:
            motion = np.array([2.0 * np.pi * 3.0 / steps, 0.0, 2.0 * np.pi / steps]) * rounds
            truth.append(move(truth[-1], motion)[0])
            motions.append(motion + np.sqrt(np.diag(covariance)) * rng.standard_normal(3))
        z, _, _ = range_bearing(truth[-1], world)
        visible = np.flatnonzero((z[:, 0] < reach) & (np.abs(z[:, 1]) < np.radians(100)) & (z[:, 0] > 0.3))
        seen.append(visible)
        noise = rng.standard_normal((len(visible), 2)) * np.array([config.sigma_range, config.sigma_bearing])
        measured.append(z[visible] + noise)
    return truth, motions, world, seen, measured


def run_filter(
    config: PlanarConfig,
    motions: list[FloatArray],
    seen: list[np.ndarray] | None,
    measured: list[FloatArray],
    covariance: FloatArray = MOTION_COVARIANCE,
) -> tuple[PlanarEkf, list[FloatArray], list[np.ndarray], float, int]:
    """The filter over a drive; ``seen`` None: unknown association. Returns poses, slots, NIS and its freedom too."""
    ekf = PlanarEkf(config, np.zeros(3), np.zeros((3, 3)))
    poses, slots, nis, dof = [], [], 0.0, 0
    for k, z in enumerate(measured):
        if k:
            ekf.predict(motions[k - 1], covariance)
        report, used = ekf.process(z, None if seen is None else seen[k])
        nis, dof = nis + report.nis, dof + report.dof
        poses.append(ekf.pose.copy())
        slots.append(used)
    return ekf, poses, slots, nis, dof


def planar_nees(runs: int, error: str, rough: bool = False) -> tuple[float, float, float]:
    """NEES of the last pose, of the landmarks, and NIS, each per degree of freedom, known association.

    ``rough``: four rounds with wheels and bearings so bad that the heading gets uncertain by degrees.
    """
    config = PlanarConfig(error=error, sigma_range=0.1, sigma_bearing=0.1) if rough else PlanarConfig(error=error)
    covariance = ROUGH_COVARIANCE if rough else MOTION_COVARIANCE
    pose, landmarks, total, dof = [], [], 0.0, 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        steps, rounds = (200, 4) if rough else (50, 1)
        truth, motions, world, seen, measured = drive(rng, config, steps, rounds=rounds, covariance=covariance)
        ekf, _, _, nis, freedom = run_filter(config, motions, seen, measured, covariance)
        e = truth[-1] - ekf.pose
        e[2] = wrap(e[2])
        P = ekf.covariance.dense()
        pose.append(float(nees(e, P[:3, :3])) / 3)
        n = len(ekf.ids)
        blocks = P[3:, 3:].reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        landmarks.append(float(nees(world[ekf.ids] - ekf.landmarks, blocks).mean()) / 2)
        total, dof = total + nis, dof + freedom
    return float(np.mean(pose)), float(np.mean(landmarks)), total / dof
