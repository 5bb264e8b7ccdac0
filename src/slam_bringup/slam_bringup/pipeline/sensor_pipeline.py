# SPDX-License-Identifier: Apache-2.0
r"""The stages of one agent's sensors, joined up without ROS: readings in, what its filter takes out.

stereo -> StereoStage -> FeatureStage -> features
depth  -> DepthStage ----^   \-> ScanOdometryStage -> motions
laser  -------------------------^
IMU    -------------------------^----------------> turn rates
odometry ----------------------------------------> poses
masks  ------> FeatureStage
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from ndt_registration.stage import Scan, ScanEstimate, ScanOdometryStage
from slam_bags.reading.readings import (
    MASK_ROLES,
    AgentSensors,
    AirReading,
    DepthReading,
    FixReading,
    ImuReading,
    LaserReading,
    MaskReading,
    PoseReading,
    Reading,
    SessionStart,
    StereoReading,
)
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.rig_sessions import RigSessions
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.types import Features, ImuSample, OdometryReading, PositionReading, PressureReading
from stereo_frontend.frame_log import FrameLog
from stereo_frontend.frontend_config import FrontendConfig, FrontendReport
from stereo_frontend.stage import ExtractedFrame, FeatureStage, StereoStage
from tof_driver.stage import DepthStage

Value: TypeAlias = (
    ExtractedFrame
    | Features
    | ScanEstimate
    | ImuSample
    | OdometryReading
    | PositionReading
    | PressureReading
    | SessionStart
)


@dataclass(frozen=True, eq=False)
class AgentItem:
    """Output of the sensors of ``agent``; an extracted frame has yet to be measured."""

    agent: str
    value: Value


class SensorPipeline:
    """The stages that a mode needs, from :meth:`add` to :meth:`measure`, for one agent or one camera of a rig.

    Parameters
    ----------
    odometry
        Whether scans are registered.
    scans
        What registers them where the cameras of a rig share it; None: one of its own.

    Raises
    ------
    ValueError
        If the agent lacks a sensor that the mode needs; the message says which mode would do.
    """

    def __init__(
        self,
        config: SystemConfig,
        sensors: AgentSensors,
        odometry: bool,
        times: StageTimes,
        scans: ScanOdometryStage | None = None,
    ) -> None:
        mode = config.feature_extractor.mode
        self._agent, self._camera = sensors.agent, sensors.camera
        self._times = times
        self._uses_stereo = mode != "tof"
        self._uses_depth = mode != "stereo" or (odometry and sensors.scanner == "depth")
        self.log = FrameLog()
        """Pictures with their features, for people to look at."""
        self._require(mode, sensors, odometry)
        self._stereo = stereo_stage(sensors)
        self._depth = depth_stage(config, sensors)
        self._mask_role = MASK_ROLES["stereo" if self._uses_stereo else "tof"]
        self._features = FeatureStage(with_masks(config.feature_extractor, sensors), sensors.frames)
        self._odometry = scans or rig_scans(config, [sensors]) if odometry else None
        self._scans_of_rig = scans or self._odometry
        self._rig: tuple[SensorPipeline, ...] = (self,)
        self._sessions = RigSessions([self._camera])

    def add(self, reading: Reading) -> Iterator[AgentItem]:
        """Take a reading; yields what it leads to. A stereo pair that waits for its ToF image comes out later."""
        if isinstance(reading, ImuReading):
            yield from self._on_imu(reading.sample)
        elif isinstance(reading, PoseReading):
            yield self._item(reading.pose)
        elif isinstance(reading, FixReading):
            yield self._item(reading.position)
        elif isinstance(reading, AirReading):
            yield self._item(reading.pressure)
        elif isinstance(reading, StereoReading) and self._uses_stereo:
            yield from self._on_pair(reading)
        elif isinstance(reading, DepthReading) and self._uses_depth:
            yield from self._on_depth(reading)
        elif isinstance(reading, MaskReading) and MASK_ROLES[reading.camera] == self._mask_role:
            self._features.add_mask(reading.mask)
            yield from self._frames()
        elif isinstance(reading, LaserReading) and self._odometry is not None:
            self._odometry.add_scan(reading.scan, self._camera)
            yield from self._scans()
        elif isinstance(reading, SessionStart):
            yield from self._on_session(reading)

    def finish(self) -> Iterator[AgentItem]:
        """Yield what still waits when the input has ended."""
        if self._odometry is not None:
            self._odometry.finish()
        self._features.finish()
        yield from self._scans()
        yield from self._frames()

    def measure(self, item: AgentItem) -> AgentItem:
        """The features of an extracted frame, anything else as it is; may run in another thread than :meth:`add`."""
        if not isinstance(item.value, ExtractedFrame):
            return item
        with self._times.measure("features"):
            features = self._features.measure(item.value)
        self.log.add(item.value, features)
        return self._item(features)

    def front_end(self) -> FrontendReport:
        """Findings of the front end about the images."""
        return self._features.report()

    def _on_session(self, start: SessionStart) -> Iterator[AgentItem]:
        """Begin a new session, after what waits of the one before; calibration and knowledge of the camera stay.

        The first camera of a rig that tells begins it for all; what others still have of the one before is left out.
        """
        if self._sessions.begins(self._camera):
            for pipeline in self._rig:
                yield from pipeline.finish()
            if self._scans_of_rig is not None:
                self._scans_of_rig.reset()
        elif self._odometry is not None:
            self._odometry.restart_camera(self._camera)
        self._stereo.reset()
        self._depth.reset()
        self._features.clear()
        yield self._item(start)

    def _on_imu(self, sample: ImuSample) -> Iterator[AgentItem]:
        yield self._item(sample)
        if self._odometry is not None:
            self._odometry.add_imu(sample)
            yield from self._scans()

    def _on_pair(self, reading: StereoReading) -> Iterator[AgentItem]:
        self._stereo.add(reading.pair)
        for images in self._times.each("rectification", self._stereo.ready()):
            self._features.add_images(images)
        yield from self._frames()

    def _on_depth(self, reading: DepthReading) -> Iterator[AgentItem]:
        self._depth.add(reading.raw)
        for depth in self._times.each("depth", self._depth.ready()):
            if self._odometry is not None:
                self._odometry.add_scan(Scan(depth.stamp_ns, depth.points(), depth.frame_id), self._camera)
            self._features.add_depth(depth)
        yield from self._scans()
        yield from self._frames()

    def _scans(self) -> Iterator[AgentItem]:
        if self._odometry is not None:
            yield from map(self._item, self._times.each("scan odometry", self._odometry.ready()))

    def _frames(self) -> Iterator[AgentItem]:
        yield from map(self._item, self._times.each("keypoints", self._features.extracted()))

    def _item(self, value: Value) -> AgentItem:
        return AgentItem(self._agent, value)

    def _require(self, mode: str, sensors: AgentSensors, odometry: bool) -> None:
        who = f"agent '{sensors.agent}'" if sensors.agent else "the bag"
        if self._uses_stereo and not {"left", "right"} <= sensors.topics.keys():
            raise ValueError(f"mode '{mode}' needs stereo images, and {who} has none: try --mode tof")
        no_scans = odometry and not sensors.scanner
        if mode != "stereo" and "depth" not in sensors.topics:
            hint = "--mode stereo without --odometry" if no_scans else "--mode stereo"
            raise ValueError(f"mode '{mode}' needs ToF images, and {who} has none: try {hint}")
        if no_scans:
            raise ValueError(f"scan odometry needs ToF images or laser scans, and {who} has none: leave --odometry out")


def rig_pipelines(
    config: SystemConfig, cameras: Sequence[AgentSensors], odometry: bool, times: StageTimes
) -> dict[str, SensorPipeline]:
    """The pipelines of the cameras of one rig by their namespaces; a rig with one camera has one.

    A camera of several that lacks what the mode needs is used as what it is, and scans come from those with depth.

    Raises
    ------
    ValueError
        If a rig with one camera lacks a sensor that the mode needs, or none of several has depth for scan odometry.
    """
    if len(cameras) == 1:
        return {cameras[0].agent: SensorPipeline(config, cameras[0], odometry, times)}
    if odometry and not any(camera.scanner for camera in cameras):
        raise ValueError("scan odometry needs ToF images, and no camera of the rig has any: leave --odometry out")
    scans = rig_scans(config, cameras) if odometry else None
    pipelines = {
        camera.agent: SensorPipeline(
            for_camera(config, camera), camera, odometry and bool(camera.scanner), times, scans
        )
        for camera in cameras
    }
    sessions = RigSessions(camera.camera for camera in cameras)
    for pipeline in pipelines.values():
        pipeline._rig, pipeline._sessions = tuple(pipelines.values()), sessions
    return pipelines


def for_camera(config: SystemConfig, camera: AgentSensors) -> SystemConfig:
    """The configuration for one of several cameras: the mode that its images are enough for."""
    mode = mode_of_camera(config.feature_extractor.mode, camera.topics)
    return replace(config, feature_extractor=of_several(replace(config.feature_extractor, mode=mode)))


def of_several(config: FrontendConfig) -> FrontendConfig:
    """The front end of one of several cameras: each of its frames maps, as others may map at the same moment."""
    return replace(config, features=replace(config.features, mapping_interval=0.0))


def mode_of_camera(mode: str, roles: Collection[str]) -> str:
    """Mode of one of several cameras with images of some ``roles``, for a rig that is run in ``mode``."""
    has_pair = {"left", "right"} <= set(roles)
    has_depth = bool({"depth", "range"} & set(roles))
    if mode != "tof" and not has_pair:
        return "tof"
    return "stereo" if mode != "stereo" and not has_depth else mode


def rig_scans(config: SystemConfig, cameras: Sequence[AgentSensors]) -> ScanOdometryStage:
    """Scan odometry of a rig with these cameras: what all that have depth measure at one moment is one scan."""
    first = cameras[0]
    names = [camera.camera for camera in cameras if camera.scanner] if first.camera else []
    return ScanOdometryStage(config.ndt_odometry, first.frames, first.base_frame, names)


def with_masks(config: FrontendConfig, sensors: AgentSensors) -> FrontendConfig:
    """The front end's parameters for an agent: where its bag has masks, frames wait for them from the first one on."""
    has_masks = MASK_ROLES["tof" if config.mode == "tof" else "stereo"] in sensors.topics
    use = "always" if has_masks and config.mask.use == "auto" else config.mask.use
    return replace(config, mask=replace(config.mask, use=use))


def stereo_stage(sensors: AgentSensors) -> StereoStage:
    """Rectification of an agent's pairs; of one without a stereo camera it gives nothing."""
    stage = StereoStage()
    for side, info in (("left", sensors.left), ("right", sensors.right)):
        if info is not None:
            stage.set_info(side, info)
    return stage


def depth_stage(config: SystemConfig, sensors: AgentSensors) -> DepthStage:
    """Processing of what an agent's depth camera measures; of one without such a camera it gives nothing."""
    stage = DepthStage(replace(config.tof_driver, measurement=sensors.measurement))
    if sensors.tof is not None:
        stage.set_info(sensors.tof)
    return stage
