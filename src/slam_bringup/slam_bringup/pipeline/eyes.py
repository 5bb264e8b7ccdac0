"""From the readings of one agent to what its filter takes: features, motions, IMU samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ndt_registration.odometry import ScanOdometry
from slam_bringup.bags.readings import AgentSensors, DepthReading, ImuReading, Reading, StereoReading
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.geometry import FloatArray
from slam_core.motion import motion_of_rig, pose_of_rig
from slam_core.types import DepthImage, Features, ImuSample, PoseEstimate, RelativeMotion, StereoImages
from stereo_frontend.depth_pairing import DepthPairing
from stereo_frontend.frontend import Frontend
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.rectify import StereoRectifier
from tof_driver.depth import DepthProcessor


@dataclass(frozen=True, eq=False)
class FilterInput:
    """One item for the filter of ``agent``; exactly one of the others is not None, but a scan may bring two."""

    agent: str
    features: Features | None = None
    imu: ImuSample | None = None
    motion: RelativeMotion | None = None
    scan_pose: PoseEstimate | None = None


@dataclass(frozen=True, eq=False)
class Glimpse:
    """One instant of ``agent``: features are found but not yet measured, :meth:`AgentEyes.complete` does that."""

    agent: str
    images: StereoImages | None
    depth: DepthImage | None
    keypoints: tuple[Keypoints, Keypoints] | None


class AgentEyes:
    """Rectification, depth, front end and scan odometry of one agent.

    Raises
    ------
    ValueError
        If the agent lacks a sensor that the mode needs; the message says which mode would do.
    """

    def __init__(self, config: SystemConfig, sensors: AgentSensors, odometry: bool, times: StageTimes) -> None:
        self._mode = config.feature_extractor.mode
        self._agent = sensors.agent
        self._times = times
        self._uses_depth = self._mode != "stereo" or odometry
        self._require(sensors)
        self.frontend = Frontend(config.feature_extractor)
        self._pairing = DepthPairing(config.feature_extractor.fusion.max_age)
        self._odometry = ScanOdometry(config.ndt_odometry) if odometry else None
        self._T_left_tof: FloatArray | None = None
        if self._mode != "tof" and sensors.left is not None and sensors.right is not None:
            self._rectifier = StereoRectifier(sensors.left, sensors.right)
        if self._uses_depth and sensors.tof is not None:
            self._depth = depth_processor(config, sensors)
            self._T_base_tof = sensors.transform("base", "tof")
        if self._mode in ("replace", "fuse"):
            self._T_left_tof = sensors.transform("left", "tof")
        self.T_rig_optical = sensors.transform("base", "tof" if self._mode == "tof" else "left")
        """Mounting of the optical frame in which the features are."""

    def process(self, reading: Reading) -> list[FilterInput | Glimpse]:
        """What a reading leads to; a stereo pair that waits for its ToF image comes out with a later reading."""
        if isinstance(reading, ImuReading):
            if self._odometry is not None:
                rate = self._T_base_tof[:3, :3].T @ reading.sample.angular_velocity
                self._odometry.add_angular_velocity(reading.sample.stamp_ns, rate)
            return [FilterInput(self._agent, imu=reading.sample)]
        if isinstance(reading, StereoReading):
            return self._on_stereo(reading) if self._mode != "tof" else []
        return self._on_depth(reading) if self._uses_depth else []

    def finish(self) -> list[FilterInput | Glimpse]:
        """The pairs that still wait."""
        return [self._glimpse(images, depth) for images, depth in self._pairing.flush()]

    def complete(self, item: FilterInput | Glimpse) -> FilterInput:
        """The filter input of a glimpse; may run in another thread than ``process``, in the same order."""
        if isinstance(item, FilterInput):
            return item
        with self._times.measure("features"):
            features = self.frontend.measure(item.keypoints, item.images, item.depth, self._T_left_tof)
        return FilterInput(self._agent, features=features)

    def _on_stereo(self, reading: StereoReading) -> list[FilterInput | Glimpse]:
        with self._times.measure("rectification"):
            images = self._rectifier(reading.stamp_ns, reading.left, reading.right)
        if self._mode == "stereo":
            return [self._glimpse(images, None)]
        return [self._glimpse(*pair) for pair in self._pairing.add_pair(images)]

    def _on_depth(self, reading: DepthReading) -> list[FilterInput | Glimpse]:
        with self._times.measure("depth"):
            depth = self._depth.process(reading.stamp_ns, reading.image, reading.amplitude, reading.intensity)
        out: list[FilterInput | Glimpse] = [] if self._odometry is None else [self._registered(self._odometry, depth)]
        if self._mode == "tof":
            out.append(self._glimpse(None, depth))
        elif self._mode != "stereo":
            out += [self._glimpse(*pair) for pair in self._pairing.add_depth(depth)]
        return out

    def _glimpse(self, images: StereoImages | None, depth: DepthImage | None) -> Glimpse:
        with self._times.measure("keypoints"):
            keypoints = self.frontend.extract(images)
        return Glimpse(self._agent, images, depth, keypoints)

    def _registered(self, odometry: ScanOdometry, depth: DepthImage) -> FilterInput:
        with self._times.measure("scan odometry"):
            result = odometry.process(depth.stamp_ns, depth.points())
        pose = PoseEstimate(depth.stamp_ns, result.T, result.covariance)
        motion = None if result.motion is None else motion_of_rig(result.motion, self._T_base_tof)
        return FilterInput(self._agent, motion=motion, scan_pose=pose_of_rig(pose, self._T_base_tof))

    def _require(self, sensors: AgentSensors) -> None:
        who = f"agent '{sensors.agent}'" if sensors.agent else "the bag"
        has_stereo, has_depth = {"left", "right"} <= sensors.topics.keys(), "depth" in sensors.topics
        if self._mode != "tof" and not has_stereo:
            raise ValueError(f"mode '{self._mode}' needs stereo images, and {who} has none: try --mode tof")
        if self._uses_depth and not has_depth:
            raise ValueError(
                f"mode '{self._mode}' or scan odometry needs ToF images, and {who} has none: try --mode stereo"
            )


def depth_processor(config: SystemConfig, sensors: AgentSensors) -> DepthProcessor:
    """The ToF driver's own processing, for what the agent's depth camera measures."""
    assert sensors.tof is not None
    measured = replace(config.tof_driver, measurement=sensors.measurement)
    return DepthProcessor(measured, sensors.tof.camera, sensors.tof.rectified)
