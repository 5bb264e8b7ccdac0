# SPDX-License-Identifier: Apache-2.0
"""The camera's pictures beside a finished run: with features from its result, or with landmarks from its bag."""

from __future__ import annotations

import bisect
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from slam_bags.reading.readings import AgentSensors, DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagReader
from slam_core.camera import Camera
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import ByteArray
from slam_viewer.page.run_folder import RunFolder

_FEATURE_PICTURES = "/features/image/compressed"
_MOST = 300
"""Pictures kept for each agent."""
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 80)


@dataclass(frozen=True, eq=False)
class CaptionedImage:
    """An RGB image (h, w, 3) uint8 and what it shows."""

    image: ByteArray
    caption: str


class StampedPictures:
    """JPEG files by agent and stamp, and what they show in words."""

    SHOWS = ""

    def __init__(self) -> None:
        self._stamps: dict[str, list[int]] = defaultdict(list)
        self._jpegs: dict[str, list[bytes]] = defaultdict(list)

    def __bool__(self) -> bool:
        return bool(self._stamps)

    def at(self, agent: str, stamp_ns: int) -> CaptionedImage | None:
        """The agent's newest picture at a stamp, or None before its first."""
        k = bisect.bisect_right(self._stamps[agent], stamp_ns) - 1
        if k < 0:
            return None
        image = cv2.imdecode(np.frombuffer(self._jpegs[agent][k], dtype=np.uint8), cv2.IMREAD_COLOR)
        assert image is not None, "written by ourselves"
        picture = np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)
        return CaptionedImage(picture, f"{agent or 'rig'}: {self.SHOWS}")


class RecordedPictures(StampedPictures):
    """The pictures with their features that a run has put into its own ``result.mcap``."""

    SHOWS = "features, red near, blue far; circle stereo, square ToF"

    def __init__(self, result: Path) -> None:
        super().__init__()
        with BagReader(result) as bag:
            topics = [topic for topic in bag.topics if topic.endswith(_FEATURE_PICTURES)]
            for topic, stamp, message in bag.messages(topics):
                agent = topic.removesuffix(_FEATURE_PICTURES).strip("/")
                self._stamps[agent].append(stamp)
                self._jpegs[agent].append(bytes(message.data))


class BagPictures(StampedPictures):
    """Pictures by agent and stamp, drawn once when the bag is read.

    A landmark is a ring whose colour says in how many submaps it is: green in one, yellow in many. It is drawn where
    the map and the pose put it: rings that do not sit on corners of the picture show an error of either.
    """

    SHOWS = "landmarks, green in one submap, yellow in many"

    def __init__(self, run: RunFolder, bag: Path) -> None:
        super().__init__()
        landmarks = run.map.landmarks()
        self._points, self._sightings = landmarks.positions[landmarks.linked], landmarks.sightings[landmarks.linked]
        with SensorBag(bag) as opened:
            every = {a: max(1, len(t) // _MOST) for a, t in run.trajectories.items()}
            firsts = {cameras[0]: rig for rig, cameras in opened.rigs.items()}
            count: dict[str, int] = defaultdict(int)
            for reading in opened.readings():
                if not isinstance(reading, StereoReading | DepthReading) or not self._is_main(opened, reading):
                    continue
                if reading.agent not in firsts:
                    continue  # of several cameras the first is shown
                agent = firsts[reading.agent]
                count[agent] += 1
                if count[agent] % every.get(agent, 1) == 0:
                    self._keep(run, agent, opened.sensors[reading.agent], reading)

    @staticmethod
    def _is_main(bag: SensorBag, reading: StereoReading | DepthReading) -> bool:
        """The left camera's pictures where there is one, else the depth camera's."""
        has_stereo = bag.sensors[reading.agent].is_mounted("left")
        return isinstance(reading, StereoReading) if has_stereo else True

    def _keep(self, run: RunFolder, agent: str, sensors: AgentSensors, reading: StereoReading | DepthReading) -> None:
        trajectory = run.trajectories.get(agent)
        image, camera, mount = _image_of(sensors, reading)
        if trajectory is None or not len(trajectory) or image is None or camera is None:
            return
        stamp = reading.stamp_ns
        if not trajectory.stamps_ns[0] <= stamp <= trajectory.stamps_ns[-1]:
            return
        T_map_camera = trajectory.interpolate(np.array([stamp]))[0] @ sensors.transform("base", mount)
        picture = draw_landmarks(image, camera, T_map_camera, self._points, self._sightings)
        self._stamps[agent].append(stamp)
        self._jpegs[agent].append(cv2.imencode(".jpg", picture, _JPEG)[1].tobytes())


def draw_landmarks(
    image: ByteArray, camera: Camera, T_map_camera: FloatArray, points: FloatArray, sightings: npt.NDArray[np.int64]
) -> ByteArray:
    """BGR picture (h, w, 3) with landmarks (n, 3) of the map nearer than 6 m, by in how many submaps they are."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
    local = transform_points(invert_transform(T_map_camera), points)
    near = (local[:, 2] > 0.3) & (local[:, 2] < 6.0)
    pixels, depth = camera.project(local[near]), local[near, 2]
    share = np.clip(np.log2(np.maximum(sightings[near], 1)) / 3.0, 0.0, 1.0)
    colours = cv2.applyColorMap((255 * share).astype(np.uint8)[:, None], cv2.COLORMAP_SUMMER).reshape(-1, 3)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    for (u, v), z, colour in zip(pixels[inside], depth[inside], colours[inside], strict=True):
        cv2.circle(picture, (round(u), round(v)), round(3 + 6 / z), colour.tolist(), 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def _image_of(
    sensors: AgentSensors, reading: StereoReading | DepthReading
) -> tuple[ByteArray | None, Camera | None, str]:
    """The image of a reading, grey or red first, its raw camera, and the name of its mount."""
    if isinstance(reading, StereoReading):
        return reading.pair.picture(), sensors.left.camera if sensors.left else None, "left"
    amplitude = reading.raw.amplitude
    grey = None if amplitude is None else np.clip(amplitude, 0, 255).astype(np.uint8)
    return grey, sensors.tof.camera if sensors.tof else None, "tof"
