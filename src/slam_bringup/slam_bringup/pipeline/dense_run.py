# SPDX-License-Identifier: Apache-2.0
"""The dense model of a bag on the trajectories of a finished run, from its key frames alone where that is possible."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing

import numpy as np

from dense_mapping.colours import NO_PICTURE
from dense_mapping.dense_stage import DenseStage
from dense_mapping.keyframes import grey_levels
from slam_bags.reading.reading_times import ReadingTimes, Stamps
from slam_bags.reading.readings import (
    MASK_ROLES,
    AgentSensors,
    ColourReading,
    DepthReading,
    ImuReading,
    MaskReading,
    Reading,
    StereoReading,
)
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.prefetch import IMAGES_AHEAD, prefetch
from slam_bringup.pipeline.sensor_pipeline import depth_stage, stereo_stage
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, DepthImage
from stereo_frontend.stage import StereoStage
from stereo_frontend.stereo.rectification_error import RectificationError
from tof_driver.stage import DepthStage


def dense_model(
    bag: SensorBag,
    config: SystemConfig,
    trajectories: Mapping[str, Trajectory],
    on_reading: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
    corrections: Mapping[str, RectificationError | None] | None = None,
    rides: Mapping[str, Sequence[tuple[int, int]]] | None = None,
) -> DenseStage:
    """The model of all agents in the map frame, of what was read until ``stopped``; its surface is not made yet.

    Every camera of a rig takes part on the rig's trajectory. ``corrections``: by agent or camera, what the
    rectification of its right images is wrong by, where that is sure. ``rides``: by agent or camera, first and last
    stamp (ns) of the lift rides.
    """
    paths = {
        camera: trajectory
        for agent, trajectory in trajectories.items()
        if len(trajectory)
        for camera in bag.rigs.get(agent, (agent,))
    }
    coloured = frozenset(a for a in paths if config.dense_mapper.use_tof and "color" in bag.sensors[a].topics)
    masked = frozenset(f"{a}/{c}" for a in paths for c, role in MASK_ROLES.items() if role in bag.sensors[a].topics)
    stage = DenseStage(config.dense_mapper, paths, coloured, masked, rides)
    cameras = {
        a: _Images(bag.sensors[a], config, stage, (path.stamps_ns[0], path.stamps_ns[-1]), (corrections or {}).get(a))
        for a, path in paths.items()
    }
    with stage, closing(_readings(bag, cameras, on_reading)) as readings:
        for reading in readings:
            if stopped() or all([camera.is_over(reading) for camera in cameras.values()]):
                break
            if reading.agent in cameras:
                cameras[reading.agent].add(reading)
        stage.finish()
    return stage


def _readings(
    bag: SensorBag, cameras: Mapping[str, _Images], on_reading: Callable[[], None]
) -> Generator[Reading, None, None]:
    """Readings of the bag: where it has been read before, its key frames alone, with what accelerometers read then."""
    times = bag.times
    if not times.is_whole or any(camera.needs_colours for camera in cameras.values()):
        with closing(prefetch(bag.readings(colours=True), _is_an_image, IMAGES_AHEAD)) as readings:
            for reading in readings:
                yield reading
                if not isinstance(reading, ColourReading):
                    on_reading()
        return
    for camera in cameras.values():
        camera.add_forces(times)
    wanted = {agent: camera.key_stamps(times) for agent, camera in cameras.items()}
    expected, passed = max(1, sum(map(len, wanted.values()))), 0
    with closing(prefetch(bag.images_at(wanted), _is_an_image, IMAGES_AHEAD)) as readings:
        for k, reading in enumerate(readings, 1):
            yield reading
            now = min(times.count, k * times.count // expected)
            for _ in range(now - passed):
                on_reading()
            passed = now


def _is_an_image(reading: Reading) -> bool:
    return not isinstance(reading, ImuReading)


class _Images:
    """Hands one agent's readings to the dense stage as depth images, pairs, colours and forces."""

    def __init__(
        self,
        sensors: AgentSensors,
        config: SystemConfig,
        stage: DenseStage,
        span_ns: tuple[int, int],
        correction: RectificationError | None,
    ) -> None:
        self._agent, self._sensors, self._out, self._span_ns = sensors.agent, sensors, stage, span_ns
        self._has_begun = False
        self._depth: DepthStage | None = None
        self._stereo: StereoStage | None = None
        self._cameras: list[tuple[type[Reading], FloatArray]] = []
        self.needs_colours = False
        """True if pictures of a colour camera belong to the depth images."""
        if config.dense_mapper.use_tof and sensors.is_mounted("tof"):
            self._depth = depth_stage(config, sensors)
            self._T_base_tof = sensors.transform("base", "tof")
            self._cameras.append((DepthReading, self._T_base_tof))
            self.needs_colours = "color" in sensors.topics
        if config.dense_mapper.use_stereo and sensors.right is not None and sensors.is_mounted("left"):
            self._stereo = stereo_stage(sensors)
            self._stereo.correct(correction)
            self._T_base_left = sensors.transform("base", "left")
            self._cameras.append((StereoReading, self._T_base_left))

    def is_over(self, reading: Reading) -> bool:
        """True if an image comes after the end of the trajectory, and not before the session that it is of."""
        if not isinstance(reading, StereoReading | DepthReading):
            return False
        first, last = self._span_ns
        self._has_begun |= first <= reading.stamp_ns <= last
        return self._has_begun and reading.stamp_ns > last

    def key_stamps(self, times: ReadingTimes) -> Stamps:
        """Stamps of the readings that make key frames, of those that a reading of the bag has passed."""
        chosen = [self._out.key_stamps(self._agent, T, times.stamps(self._agent, kind)) for kind, T in self._cameras]
        return np.concatenate([np.empty(0, dtype=np.int64), *chosen])

    def add_forces(self, times: ReadingTimes) -> None:
        """Take what the accelerometer read while the bag was read."""
        for frame, stamps, forces in times.forces(self._agent):
            for stamp, force in zip(stamps.tolist(), forces, strict=True):
                self._add_force(frame, stamp, force)

    def _add_force(self, frame: str, stamp_ns: int, force: FloatArray) -> None:
        R_base_imu = self._sensors.frames.lookup(self._sensors.base_frame, frame)[:3, :3]
        self._out.add_force(self._agent, stamp_ns, R_base_imu @ force)

    def add(self, reading: Reading) -> None:
        """Take a reading; of an image only if it makes a key frame."""
        if isinstance(reading, DepthReading) and self._depth is not None:
            if self._out.wants(self._agent, "tof", reading.stamp_ns, self._T_base_tof):
                self._depth.add(reading.raw)
                for image in self._depth.ready():
                    self._out.add(self._agent, "tof", self._T_base_tof, image, self._picture(image))
        elif isinstance(reading, ColourReading) and self._depth is not None:
            self._out.add_colour(self._agent, "tof", reading.stamp_ns, self._depth.colour(reading.image))
        elif isinstance(reading, MaskReading):
            self._out.add_mask(self._agent, reading.camera, reading.mask)
        elif isinstance(reading, ImuReading):
            sample = reading.sample
            self._add_force(sample.frame_id, sample.stamp_ns, sample.linear_acceleration)
        elif isinstance(reading, StereoReading) and self._stereo is not None:
            self._out.add_pair(self._agent, self._T_base_left, reading.pair, self._stereo)

    def _picture(self, image: DepthImage) -> ByteArray:
        """A ToF amplitude is no picture where stereo gives one: two kinds of grey on one wall are blotches."""
        if self._stereo is not None or self.needs_colours:
            return NO_PICTURE
        if image.amplitude is not None:
            return grey_levels(image.amplitude)
        return NO_PICTURE if image.intensity is None else np.rint(255.0 * image.intensity).astype(np.uint8)
