"""The dense model of a bag on the trajectories of a finished run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_bringup.bags.readings import AgentSensors, DepthReading, Reading, StereoReading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_map import ColouredCloud, DenseMap
from slam_bringup.pipeline.eyes import depth_processor
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from stereo_frontend.rectify import StereoRectifier


def dense_model(bag: SensorBag, config: SystemConfig, trajectories: Mapping[str, Trajectory]) -> ColouredCloud:
    """Depth of the key frames of all agents in the map frame: of the ToF camera where there is one, else of stereo."""
    builders = {
        agent: _AgentModel(bag.sensors[agent], config, trajectory)
        for agent, trajectory in trajectories.items()
        if len(trajectory)
    }
    last_ns = max((int(t.stamps_ns[-1]) for t in trajectories.values() if len(t)), default=0)
    for reading in bag.readings():
        if isinstance(reading, StereoReading | DepthReading) and reading.stamp_ns > last_ns:
            break
        if reading.agent in builders:
            builders[reading.agent].add(reading)
    clouds = [builder.model.fuse() for builder in builders.values()]
    if not clouds:
        return ColouredCloud.empty()
    return ColouredCloud(np.concatenate([c.points for c in clouds]), np.concatenate([c.grey for c in clouds]))


class _AgentModel:
    def __init__(self, sensors: AgentSensors, config: SystemConfig, trajectory: Trajectory) -> None:
        self.model = DenseMap(config.dense_map)
        self._trajectory = trajectory
        self._depth = self._rectifier = None
        if sensors.is_mounted("tof"):
            self._depth = depth_processor(config, sensors)
            self._T_base_optical = sensors.transform("base", "tof")
        elif sensors.left is not None and sensors.right is not None and sensors.is_mounted("left"):
            self._rectifier = StereoRectifier(sensors.left, sensors.right)
            self._T_base_optical = sensors.transform("base", "left")

    def add(self, reading: Reading) -> None:
        """Add the reading if it is of the camera that makes the model, and of a key frame."""
        if isinstance(reading, DepthReading) and self._depth is not None:
            pose = self._key_pose(reading.stamp_ns)
            if pose is not None:
                depth = self._depth.process(reading.stamp_ns, reading.image, reading.amplitude, reading.intensity)
                self.model.add_depth(pose, depth)
        elif isinstance(reading, StereoReading) and self._rectifier is not None:
            pose = self._key_pose(reading.stamp_ns)
            if pose is not None:
                self.model.add_stereo(pose, self._rectifier(reading.stamp_ns, reading.left, reading.right))

    def _key_pose(self, stamp_ns: int) -> FloatArray | None:
        """T_map_optical if the stamp lies within the trajectory and its pose makes a key frame."""
        stamps = self._trajectory.stamps_ns
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            return None
        T = self._trajectory.interpolate(np.array([stamp_ns]))[0]
        return np.asarray(T @ self._T_base_optical) if self.model.wants(T) else None
