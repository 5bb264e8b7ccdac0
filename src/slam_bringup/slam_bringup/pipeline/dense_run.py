# SPDX-License-Identifier: Apache-2.0
"""The dense model of a bag on the trajectories of a finished run: depth of the ToF camera and of stereo, fused."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Self

import numpy as np

from dense_mapping.colours import NO_PICTURE, RecentColours, stereo_picture
from dense_mapping.dense_model import DenseConfig, DenseModel
from dense_mapping.keyframes import KeyframeSelector, grey_levels
from dense_mapping.stereo_depth import stereo_depth
from slam_bringup.bags.reading_times import ReadingTimes, Stamps
from slam_bringup.bags.readings import AgentSensors, ColourReading, DepthReading, ImuReading, Reading, StereoReading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.pipeline.ahead import ahead
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.sensor_pipeline import depth_stage, stereo_stage
from slam_core.geometry import FloatArray
from slam_core.memory import give_back, trim
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, DepthImage
from stereo_frontend.corrected_info import corrected_right
from stereo_frontend.rectification_error import RectificationError
from stereo_frontend.stage import StereoStage
from tof_driver.stage import DepthStage

_TRIMMED = 4
"""Key frames after which freed memory is returned."""


def dense_model(
    bag: SensorBag,
    config: SystemConfig,
    trajectories: Mapping[str, Trajectory],
    on_reading: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
    corrections: Mapping[str, RectificationError | None] | None = None,
) -> DenseModel:
    """The model of all agents in the map frame, of what was read until ``stopped``; its surface is not made yet.

    ``corrections``: by agent, what the rectification of its right images is wrong by, where that is sure.
    """
    model = DenseModel(config.dense_mapper, fixed=True)
    cameras = {
        agent: AgentDepth(bag.sensors[agent], config, trajectory, (corrections or {}).get(agent))
        for agent, trajectory in trajectories.items()
        if len(trajectory)
    }
    with FieldThread(model) as field, closing(_readings(bag, cameras, on_reading)) as readings:
        for reading in readings:
            if stopped() or all(camera.is_over(reading) for camera in cameras.values()):
                break
            if reading.agent in cameras:
                cameras[reading.agent].add(reading, field)
        for camera in cameras.values():
            camera.finish(field)
    return model


def _readings(
    bag: SensorBag, cameras: Mapping[str, AgentDepth], on_reading: Callable[[], None]
) -> Generator[Reading, None, None]:
    """Readings of the bag: where it has been read before, its key frames alone, with what accelerometers read then."""
    times = bag.times
    if not times.is_whole or any(camera.needs_colours for camera in cameras.values()):
        with closing(ahead(bag.readings(colours=True), _is_an_image)) as readings:
            for reading in readings:
                yield reading
                if not isinstance(reading, ColourReading):
                    on_reading()
        return
    for camera in cameras.values():
        camera.add_forces(times)
    wanted = {agent: camera.key_stamps(times) for agent, camera in cameras.items()}
    expected, passed = max(1, sum(map(len, wanted.values()))), 0
    with closing(ahead(bag.images_at(wanted), _is_an_image)) as readings:
        for k, reading in enumerate(readings, 1):
            yield reading
            now = min(times.count, k * times.count // expected)
            for _ in range(now - passed):
                on_reading()
            passed = now


def _is_an_image(reading: Reading) -> bool:
    return not isinstance(reading, ImuReading)


class FieldThread:
    """The model, whose key frames are put into its field by a thread: the depth of the next is measured meanwhile."""

    def __init__(self, model: DenseModel) -> None:
        self.model = model
        self._added = 0
        self._pool = ThreadPoolExecutor(1, "field")
        self._last: Future[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._pool:
            self._wait()

    def add(self, camera: str, T_map_camera: FloatArray, image: DepthImage, picture: ByteArray | None) -> None:
        """Put a key frame into the model when the one before is there."""
        self._wait()
        self._last = self._pool.submit(self.model.add, camera, T_map_camera, image, picture)
        self._added += 1
        if self._added == _TRIMMED:
            give_back()  # all that measuring and fusing needs is loaded
        elif self._added % _TRIMMED == 0:
            trim()

    def _wait(self) -> None:
        if self._last is not None:
            self._last.result()


class AgentDepth:
    """Key frames of one agent's cameras on its trajectory."""

    def __init__(
        self,
        sensors: AgentSensors,
        config: SystemConfig,
        trajectory: Trajectory,
        correction: RectificationError | None = None,
    ) -> None:
        self._config: DenseConfig = config.dense_mapper
        self._agent, self._trajectory, self._sensors = sensors.agent, trajectory, sensors
        self._has_begun = False
        self._depth: DepthStage | None = None
        self._stereo: StereoStage | None = None
        self._forces: list[tuple[int, FloatArray]] = []
        self._has_colours = config.dense_mapper.use_tof and "color" in sensors.topics
        self._cameras: list[tuple[type[Reading], FloatArray]] = []
        self._colours = RecentColours()
        self._uncoloured: list[tuple[str, FloatArray, DepthImage]] = []
        if self._config.use_tof and sensors.is_mounted("tof"):
            self._depth = depth_stage(config, sensors)
            self._T_base_tof = sensors.transform("base", "tof")
            self._cameras.append((DepthReading, self._T_base_tof))
        if self._config.use_stereo and sensors.right is not None and sensors.is_mounted("left"):
            if correction is not None:
                sensors = replace(sensors, right=corrected_right(sensors.right, correction)[0])
            self._stereo = stereo_stage(sensors)
            self._T_base_left = sensors.transform("base", "left")
            self._cameras.append((StereoReading, self._T_base_left))

    @property
    def needs_colours(self) -> bool:
        """True if pictures of a colour camera belong to the depth images."""
        return self._has_colours and self._depth is not None

    def is_over(self, reading: Reading) -> bool:
        """True if an image comes after the end of the trajectory, and not before the session that it is of."""
        if not isinstance(reading, StereoReading | DepthReading):
            return False
        first, last = self._trajectory.stamps_ns[[0, -1]]
        self._has_begun |= first <= reading.stamp_ns <= last
        return self._has_begun and reading.stamp_ns > last

    def key_stamps(self, times: ReadingTimes) -> Stamps:
        """Stamps of the readings that make key frames, of those that a reading of the bag has passed."""
        chosen, span = [np.empty(0, dtype=np.int64)], self._trajectory.stamps_ns[[0, -1]]
        for kind, T_base_camera in self._cameras:
            stamps = times.stamps(self._agent, kind)
            stamps = stamps[(stamps >= span[0]) & (stamps <= span[1])]
            selector = KeyframeSelector(self._config.keyframe)
            poses = self._trajectory.interpolate(stamps) @ T_base_camera
            chosen.append(stamps[[selector.wants(T) for T in poses]] if len(stamps) else stamps)
        return np.concatenate(chosen)

    def add_forces(self, times: ReadingTimes) -> None:
        """Take what the accelerometer read while the bag was read."""
        for frame, stamps, forces in times.forces(self._agent):
            R_base_imu = self._sensors.frames.lookup(self._sensors.base_frame, frame)[:3, :3]
            self._forces += [(stamp, R_base_imu @ force) for stamp, force in zip(stamps.tolist(), forces, strict=True)]

    def add(self, reading: Reading, field: FieldThread) -> None:
        """Put the reading into the model if it is an image of a key frame."""
        if isinstance(reading, DepthReading) and self._depth is not None:
            for camera, T in self._wanted(field, "tof", reading.stamp_ns, self._T_base_tof):
                self._depth.add(reading.raw)
                for image in self._depth.ready():
                    self._add_depth(field, camera, T, image)
        elif isinstance(reading, ColourReading) and self._depth is not None:
            if (picture := self._depth.colour(reading.image)) is not None:
                self._colours.add(reading.stamp_ns, picture)
            self._put_coloured(field, reading.stamp_ns)
        elif isinstance(reading, ImuReading):
            R_base_imu = self._sensors.frames.lookup(self._sensors.base_frame, reading.sample.frame_id)[:3, :3]
            self._forces.append((reading.sample.stamp_ns, R_base_imu @ reading.sample.linear_acceleration))
        elif isinstance(reading, StereoReading) and self._stereo is not None:
            for camera, T in self._wanted(field, "stereo", reading.stamp_ns, self._T_base_left):
                self._stereo.add(reading.pair)
                for images in self._stereo.ready():
                    depth = stereo_depth(images, self._config.stereo)
                    field.add(camera, T, depth, stereo_picture(images, self._has_colours))

    def _add_depth(self, field: FieldThread, camera: str, T: FloatArray, image: DepthImage) -> None:
        """Put a depth image into the model, or keep it until its colours have come."""
        if self._has_colours:
            self._uncoloured.append((camera, T, image))
        else:
            field.add(camera, T, image, self._picture(image))

    def _put_coloured(self, field: FieldThread, until_ns: int | None = None) -> None:
        """Put those depth images into the model whose colours have come if they ever do: a later picture is here."""
        while self._uncoloured and (until_ns is None or self._uncoloured[0][2].stamp_ns <= until_ns):
            camera, T, image = self._uncoloured.pop(0)
            picture = self._colours.near(image.stamp_ns)
            field.add(camera, T, image, NO_PICTURE if picture is None else picture)

    def finish(self, field: FieldThread) -> None:
        """Give the model what waits, and what the accelerometer read along the trajectory: poses cost one by one."""
        self._put_coloured(field)
        stamps = self._trajectory.stamps_ns
        inside = [(stamp, force) for stamp, force in self._forces if stamps[0] <= stamp <= stamps[-1]]
        if inside:
            poses = self._trajectory.interpolate(np.array([stamp for stamp, _ in inside]))
            forces = np.array([force for _, force in inside])
            field.model.add_specific_force(np.einsum("nij,nj->i", poses[:, :3, :3], forces))

    def _wanted(
        self, field: FieldThread, sensor: str, stamp_ns: int, T_base_camera: FloatArray
    ) -> Iterator[tuple[str, FloatArray]]:
        """Name and pose T_map_camera if the stamp lies within the trajectory and its pose makes a key frame."""
        T_map_base = self._pose(stamp_ns)
        camera = f"{self._agent}/{sensor}"
        if T_map_base is not None and field.model.wants(camera, T_map_base @ T_base_camera):
            yield camera, T_map_base @ T_base_camera

    def _pose(self, stamp_ns: int) -> FloatArray | None:
        """T_map_base at a stamp, or None outside the trajectory."""
        stamps = self._trajectory.stamps_ns
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            return None
        return np.asarray(self._trajectory.interpolate(np.array([stamp_ns]))[0])

    def _picture(self, image: DepthImage) -> ByteArray | None:
        """A ToF amplitude is no picture where stereo gives one: two kinds of grey on one wall are blotches."""
        if self._stereo is None and image.amplitude is not None:
            return grey_levels(image.amplitude)
        if self._stereo is None and image.intensity is not None:
            return np.asarray(np.rint(255.0 * image.intensity), dtype=np.uint8)
        return NO_PICTURE
