# SPDX-License-Identifier: Apache-2.0
"""Names for the landmarks of a log, found by following several hypotheses over the whole drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import PlanarConfig
from slam_experiments.planar.hypotheses import HypothesesConfig, PlanarHypotheses
from slam_experiments.planar.log import RobotLog

_LEAST_SIGHTINGS = 3
"""A landmark seen less often is left out: it may be a stray echo."""


def named(robot: RobotLog, start: FloatArray, config: PlanarConfig, tree: HypothesesConfig | None = None) -> RobotLog:
    """The robot with the names that the most probable hypothesis gives; sightings without one are left out.

    start: pose (3,) of its first step. The log's own names are not looked at.
    """
    sizes = [len(z) for z in robot.observations]
    if not sum(sizes):
        return robot
    range_m, bearing_rad = np.ptp(np.concatenate(robot.observations), axis=0)
    area = max(range_m, config.sigma_range) * max(bearing_rad, config.sigma_bearing)
    hypotheses = PlanarHypotheses(config, start, area, tree)
    for k, z in enumerate(robot.observations):
        if k:
            hypotheses.predict(robot.motions[k - 1], robot.motion_covariances[k - 1])
        hypotheses.process(z)
    found = hypotheses.best()
    often = np.bincount(found)[found] >= _LEAST_SIGHTINGS
    parts = zip(robot.observations, *(np.split(a, np.cumsum(sizes)[:-1]) for a in (found, often)), strict=True)
    kept = [(z[good], names[good]) for z, names, good in parts]
    return replace(robot, observations=tuple(z for z, _ in kept), ids=tuple(names for _, names in kept))
