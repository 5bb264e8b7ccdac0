# SPDX-License-Identifier: Apache-2.0
"""The 2D world of the thesis (1.7, 5.1, 6.5).

Landmarks on a plane, a rig that drives a loop, range, bearing and odometry.

    run = simulate_planar(PlanarWorldConfig(), np.random.default_rng(1))
    run.poses, run.odometry, run.observations[k].ids

A pose is (x, y, heading), Eq. 5.1. Odometry is the motion in the frame of the pose before; bearing is from the rig's
x axis, counter-clockwise. Association is known by ``ids``; an estimator that may not know it ignores them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray


@dataclass(frozen=True)
class PlanarWorldConfig(Config):
    """The thesis's experiment: 50 samples, range noise 5 cm, bearing noise 0.01 to 0.1 rad."""

    samples: int = parameter(50, "poses along the loop", minimum=2)
    landmarks: int = parameter(40, "landmarks", minimum=1)
    size: float = parameter(10.0, "side of the square in which the landmarks lie", unit="m", minimum=0.1)
    radius: float = parameter(3.0, "radius of the loop", unit="m", minimum=0.01)
    laps: float = parameter(1.1, "loops driven; beyond one the start is seen again", minimum=0.01)
    max_range: float = parameter(4.0, "how far the rig sees", unit="m", minimum=0.1)
    field_of_view: float = parameter(np.pi, "how wide the rig sees", unit="rad", minimum=0.01, maximum=2 * np.pi)
    sigma_range: float = parameter(0.05, "range noise", unit="m", minimum=0.0)
    sigma_bearing: float = parameter(0.01, "bearing noise", unit="rad", minimum=0.0)
    sigma_step: float = parameter(0.02, "odometry noise along and across the step", unit="m", minimum=0.0)
    sigma_turn: float = parameter(0.01, "odometry noise of the turn", unit="rad", minimum=0.0)


@dataclass(frozen=True, eq=False)
class PlanarObservation:
    """Landmarks seen from one pose: ``ids`` (n,), ``ranges`` (n,) m, ``bearings`` (n,) rad."""

    ids: npt.NDArray[np.int64]
    ranges: FloatArray
    bearings: FloatArray


@dataclass(frozen=True, eq=False)
class PlanarRun:
    """One simulated drive.

    poses: true (x, y, heading), shape (samples, 3); landmarks: true (n, 2) m; odometry: noisy motions, shape
    (samples - 1, 3), the k-th from pose k to k + 1 in the frame of pose k; observations: one per pose.
    """

    config: PlanarWorldConfig
    poses: FloatArray
    landmarks: FloatArray
    odometry: FloatArray
    observations: tuple[PlanarObservation, ...]


def simulate_planar(config: PlanarWorldConfig, rng: np.random.Generator) -> PlanarRun:
    """One drive round a circle, counter-clockwise, among random landmarks."""
    angle = np.linspace(0.0, 2.0 * np.pi * config.laps, config.samples)
    poses = np.column_stack([config.radius * np.sin(angle), -config.radius * np.cos(angle), angle])
    poses[:, 2] = wrap_angle(poses[:, 2])
    landmarks = rng.uniform(-config.size / 2, config.size / 2, (config.landmarks, 2))
    spread = np.array([config.sigma_step, config.sigma_step, config.sigma_turn])
    odometry = relative_motion(poses[:-1], poses[1:]) + spread * rng.standard_normal((config.samples - 1, 3))
    observations = tuple(_observe(pose, landmarks, config, rng) for pose in poses)
    return PlanarRun(config, poses, landmarks, odometry, observations)


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Angle (rad) between -pi (included) and pi."""
    return np.asarray(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi)


def relative_motion(start: FloatArray, end: FloatArray) -> FloatArray:
    """Poses ``end`` (n, 3) in the frames of ``start`` (n, 3)."""
    d, c, s = end - start, np.cos(start[:, 2]), np.sin(start[:, 2])
    return np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], wrap_angle(d[:, 2])])


def _observe(
    pose: FloatArray, landmarks: FloatArray, config: PlanarWorldConfig, rng: np.random.Generator
) -> PlanarObservation:
    d = landmarks - pose[:2]
    distance, bearing = np.hypot(d[:, 0], d[:, 1]), wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - pose[2])
    ids = np.flatnonzero((distance < config.max_range) & (np.abs(bearing) <= config.field_of_view / 2))
    ranges = distance[ids] + config.sigma_range * rng.standard_normal(len(ids))
    bearings = wrap_angle(bearing[ids] + config.sigma_bearing * rng.standard_normal(len(ids)))
    return PlanarObservation(ids.astype(np.int64), ranges, bearings)
