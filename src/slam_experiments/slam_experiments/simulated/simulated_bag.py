# SPDX-License-Identifier: Apache-2.0
"""Renders a scenario to a bag with ground truth.

Topics are those that the drivers publish and read, below each agent's namespace. The bag's times are header stamps,
so the same scenario and seed give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import cv2
import numpy as np

from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import (
    BASE_FRAME,
    IMU_FRAME,
    LEFT_FRAME,
    RIGHT_FRAME,
    TOF_FRAME,
    WORLD_FRAME,
    SensorWriter,
)
from slam_calibration.length_error import parameter_file
from slam_core.camera import CameraInfo
from slam_core.geometry import FloatArray
from slam_core.messages import compressed_image_message, header_message, transform_message
from slam_core.types import ByteArray
from slam_simulation import Scenario, SimulatedFrame, Simulator
from slam_simulation.sensors.position import BUILDING_FRAME
from slam_simulation.sensors.stereo_sensor import SIDES
from slam_simulation.sensors.tof_sensor import TofImages
from slam_simulation.sensors.wheels import FRAME
from slam_simulation.world.surface_table import compile_world

IMAGE_FORMATS = ("raw", "png", "jpeg")


@dataclass(frozen=True)
class BagOptions:
    """Storage of a simulated bag.

    images: "raw" Image messages, or CompressedImage "png" (lossless) or "jpeg" (quality 90). compact: ToF images in
    16 bits (mm and counts, no intensity): their rounding is a tenth of the sensor's noise. truth: add the true depth of
    the left image on ``ground_truth/depth``. rectified: stereo images without distortion, as ``image_rect``.
    overwrite: replace a bag of ours.
    """

    images: str = "raw"
    compact: bool = False
    truth: bool = False
    rectified: bool = False
    storage: str = "mcap"
    every: int = 1
    overwrite: bool = False


def write_bag(
    scenario: Scenario,
    output: Path,
    options: BagOptions | None = None,
    threads: int | None = None,
    advance: Callable[[], object] = lambda: None,
) -> None:
    """Render all agents of a scenario into one bag; ``advance`` is called after every frame."""
    options = options or BagOptions()
    world = compile_world(scenario.world())
    agents = [
        Simulator(scenario, k, world, threads, camera=camera, truth=options.truth, rectified=options.rectified)
        for k in range(len(scenario.agents))
        for camera in range(max(1, len(scenario.cameras)))
    ]
    error = agents[0].stereo.calibration_error
    calibration = "" if error.is_exact else parameter_file(error)
    with BagWriter(output, options.storage, overwrite=options.overwrite, calibration=calibration) as bag:
        writers = {(s.agent_name, s.camera_name): SimulationWriter(bag, s, options) for s in agents}
        for writer in writers.values():
            writer.mountings(min(s.stamp_ns(0) for s in agents))
        for frame in merge(*(s.run(every=options.every) for s in agents), key=lambda f: f.stamp_ns):
            writers[frame.agent, frame.camera].frame(frame)
            advance()


class SimulationWriter(SensorWriter):
    """Writes the frames of one agent or camera: the sensors' topics, and what only a simulation knows."""

    def __init__(self, bag: BagWriter, simulator: Simulator, options: BagOptions) -> None:
        super().__init__(bag, simulator.agent_name, simulator.camera_name)
        self._simulator, self._options = simulator, options

    def mountings(self, stamp: int) -> None:
        """Mountings of the sensors on the rig."""
        s, sensors = self._simulator, self._simulator.scenario.sensors
        T_rig_right = s.T_rig_left.copy()
        T_rig_right[1, 3] -= s.stereo.stereo.baseline
        frames: dict[str, FloatArray] = {}
        if "stereo" in sensors:
            frames |= {LEFT_FRAME: s.T_rig_left, RIGHT_FRAME: T_rig_right}
        if "tof" in sensors:
            frames[TOF_FRAME] = s.T_rig_tof
        if "imu" in sensors and s.camera == 0:
            frames[IMU_FRAME] = np.eye(4)
        if s.wheels is not None:
            frames[FRAME] = s.wheels.T_rig_frame
        self.extrinsics(stamp, frames)

    def frame(self, frame: SimulatedFrame) -> None:
        """All that one frame brings."""
        for sample in frame.imu:
            self.imu(sample)
        for reading in frame.wheels:
            self.odometry(reading)
        for position in frame.positions:
            self.position(position, BUILDING_FRAME)
        for pressure in frame.pressures:
            self.pressure(pressure)
        if self._simulator.camera == 0:
            self.ground_truth(frame.stamp_ns, frame.T_world_rig)
            self._moving_truth(frame.stamp_ns, frame.T_world_rig)
        if frame.left is not None and frame.right is not None:
            stamps = (frame.stamp_ns, frame.right_stamp_ns)
            for k, (stamp, image) in enumerate(zip(stamps, (frame.left, frame.right), strict=True)):
                self._stereo_image(k, stamp, image)
        if frame.tof is not None:
            self._tof(frame.stamp_ns, frame.tof)
        if frame.truth is not None:
            self.picture("ground_truth/depth", frame.stamp_ns, LEFT_FRAME, frame.truth.depth)

    def _moving_truth(self, stamp: int, T_world_rig: FloatArray) -> None:
        """The true pose on ``/tf``, not as base_link: a frame has one parent, and the estimators give it theirs."""
        child = self._frame(f"ground_truth/{BASE_FRAME}")
        transform = transform_message(self._types, stamp, WORLD_FRAME, child, T_world_rig)
        self._bag.write("/tf", self._types.TFMessage(transforms=[transform]), stamp)

    def _stereo_image(self, k: int, stamp: int, image: ByteArray) -> None:
        side, frame = SIDES[k], (LEFT_FRAME, RIGHT_FRAME)[k]
        topic = f"stereo/{side}/image_{'rect' if self._options.rectified else 'raw'}"
        self.info(f"stereo/{side}/camera_info", stamp, frame, self._simulator.stereo.infos[k])
        if self._options.images == "raw":
            self.picture(topic, stamp, frame, image)
            return
        header = header_message(self._types, stamp, self._frame(frame))
        message = compressed_image_message(
            self._types, header, encode(image, self._options.images), self._options.images
        )
        self._bag.write(f"{self._camera_prefix}/{topic}/compressed", message, stamp)

    def _tof(self, stamp: int, images: TofImages) -> None:
        info = CameraInfo(self._simulator.tof.camera)
        if self._options.compact:
            distance, amplitude = (np.rint(i).astype(np.uint16) for i in (images.range * 1000.0, images.amplitude))
            self.depth(stamp, distance, info, measurement="range", amplitude=amplitude)
        else:
            pictures = {"amplitude": images.amplitude, "intensity": images.intensity}
            self.depth(stamp, images.range, info, measurement="range", **pictures)


def encode(image: ByteArray, kind: str) -> bytes:
    """A grey image as a file: "png" without loss, or "jpeg" of quality 90."""
    png, jpeg = (".png", [cv2.IMWRITE_PNG_COMPRESSION, 3]), (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 90])
    suffix, setting = png if kind == "png" else jpeg
    ok, data = cv2.imencode(suffix, image, setting)
    if not ok:
        raise ValueError(f"OpenCV cannot encode {kind} images")
    return bytes(data)
