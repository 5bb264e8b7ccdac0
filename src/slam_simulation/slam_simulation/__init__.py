# SPDX-License-Identifier: Apache-2.0
"""A simulated building and the rig that moves through it.

Worlds of textured surfaces, a ray caster, cameras and motion.

    scenario = Scenario.load("small_room")
    for frame in simulate(scenario):
        ...  # frame.left, frame.right, frame.tof, frame.imu, frame.T_world_rig

:mod:`world` holds surfaces, :mod:`building` and :mod:`furniture` make them from a floor plan, :mod:`raycaster` and
:mod:`shading` draw them, :mod:`stereo_sensor`, :mod:`tof_sensor` and :mod:`imu` add what real sensors add,
:mod:`trajectory` moves the rig, :mod:`feature_level` and :mod:`planar` simulate features without images.
"""

from slam_simulation.feature_level import FeatureFrame, FeatureLevelConfig, FeatureSimulator, simulate_features
from slam_simulation.planar import PlanarRun, PlanarWorldConfig, simulate_planar
from slam_simulation.scenario import Scenario
from slam_simulation.simulator import SimulatedFrame, Simulator, simulate

__all__ = [
    "FeatureFrame",
    "FeatureLevelConfig",
    "FeatureSimulator",
    "PlanarRun",
    "PlanarWorldConfig",
    "Scenario",
    "SimulatedFrame",
    "Simulator",
    "simulate",
    "simulate_features",
    "simulate_planar",
]
