# SPDX-License-Identifier: Apache-2.0
"""A range-bearing log of one or several robots, as the planar estimators take it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class RobotLog:
    """One robot: n steps, each a motion from the step before and what is seen then.

    name: of the robot; stamps: (n,) s; motions: (n - 1, 3) m, m, rad in the frame of the step before;
    motion_covariances: (n - 1, 3, 3); observations: per step range m and bearing rad (k, 2), and ids: whose they are
    (k,); truth: (n, 3) m, m, rad in the world, or None.
    """

    name: str
    stamps: FloatArray
    motions: FloatArray
    motion_covariances: FloatArray
    observations: tuple[FloatArray, ...]
    ids: tuple[npt.NDArray[np.int64], ...]
    truth: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PlanarLog:
    """The robots of one recording, the noise of their measurements and the true landmarks (by id), where known."""

    name: str
    robots: tuple[RobotLog, ...]
    sigma_range: float
    sigma_bearing: float
    landmarks: dict[int, FloatArray] = field(default_factory=dict)
