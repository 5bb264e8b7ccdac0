# SPDX-License-Identifier: Apache-2.0
"""Simulated time-of-flight scans at chosen poses in a scenario's building, and the motions of the thesis."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray, invert_transform, make_transform, rotation_from_euler
from slam_simulation.scenario import Scenario
from slam_simulation.sensors.tof_sensor import TofSensor
from slam_simulation.world.surface_table import compile_world
from tof_driver.depth import DepthConfig, DepthProcessor

SCANS = 15
"""Scans per motion, as in the thesis (10.1)."""

Motion = tuple[float, float, float]

THESIS_MOTIONS: dict[str, Motion] = {
    "forward 25 cm": (0.25, 0.0, 0.0),
    "forward 50 cm": (0.50, 0.0, 0.0),
    "forward 75 cm": (0.75, 0.0, 0.0),
    "forward 100 cm": (1.00, 0.0, 0.0),
    "sideways 25 cm": (0.0, 0.25, 0.0),
    "sideways 50 cm": (0.0, 0.50, 0.0),
    "sideways 75 cm": (0.0, 0.75, 0.0),
    "sideways 100 cm": (0.0, 1.00, 0.0),
    "(25, 25) cm": (0.25, 0.25, 0.0),
    "yaw +10 deg": (0.0, 0.0, 10.0),
    "yaw -10 deg": (0.0, 0.0, -10.0),
    "yaw 10 deg, 25 cm": (0.25, 0.0, 10.0),
}
"""Forward m, left m, yaw deg of the source scan in the target scan's rig frame (Tables 10.1 and 10.2, Figs.
10.1-10.17).
"""

HARDER_MOTIONS: dict[str, Motion] = {
    "yaw 20 deg": (0.0, 0.0, 20.0),
    "yaw 30 deg": (0.0, 0.0, 30.0),
    "forward 100 cm, 10 deg": (1.00, 0.0, 10.0),
    "sideways 100 cm, 10 deg": (0.0, 1.00, -10.0),
}
"""Beyond the thesis; the sideways one turns back towards what it leaves, as one who looks at a thing does."""


class TofRoom:
    """A ToF camera that can be put anywhere in the building of a scenario, or of that named or in a YAML file."""

    def __init__(self, scenario: str | Scenario = "tof_grid") -> None:
        description = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        self._world = compile_world(description.world())
        self._sensor = TofSensor(description.suite.tof, description.seed)
        self._depth = DepthProcessor(DepthConfig(), self._sensor.camera)

    def scan(self, T_world_rig: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Points (n, 3) m in the camera's optical frame of one noisy scan."""
        images = self._sensor.capture(self._world, T_world_rig, rng, None)
        depth = self._depth.process(0, images.range, images.amplitude, images.intensity)
        points = depth.points().reshape(-1, 3).astype(np.float64)
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def motion(self, motion: Motion) -> FloatArray:
        """T_target_source of the camera when the rig makes a motion (forward m, left m, yaw deg)."""
        T_rig_tof = self._sensor.T_rig_tof
        return np.asarray(invert_transform(T_rig_tof) @ rig_motion(motion) @ T_rig_tof)


def rig_motion(motion: Motion) -> FloatArray:
    """Pose of the rig after a motion (forward m, left m, yaw deg)."""
    return make_transform(rotation_from_euler(np.deg2rad(motion[2])), np.array([motion[0], motion[1], 0.0]))


def rig_pose(x: float, y: float, z: float = 1.1, yaw_deg: float = 0.0) -> FloatArray:
    """T_world_rig of a rig that stands level."""
    return make_transform(rotation_from_euler(np.deg2rad(yaw_deg)), np.array([x, y, z]))


def thinned(points: FloatArray, share: float, rng: np.random.Generator) -> FloatArray:
    """A random share (0 to 1) of the points."""
    return points[rng.permutation(len(points))[: max(1, round(share * len(points)))]]
