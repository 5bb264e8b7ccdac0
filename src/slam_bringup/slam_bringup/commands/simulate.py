"""``slam simulate``: renders a scenario to a bag with ground truth.

Topics are those that the drivers publish and read, below each agent's namespace. The bag's times are header stamps, so the
same scenario and seed give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from heapq import merge
from pathlib import Path

import click
import cv2
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from slam_bringup.bag import BagWriter
from slam_bringup.bag_types import BagTypes
from slam_core.camera import CameraInfo
from slam_core.messages import (
    camera_info_message,
    compressed_image_message,
    header_message,
    image_message,
    imu_message,
    pose_stamped_message,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.simulation import Scenario, SimulatedFrame, Simulator
from slam_core.simulation.stereo_sensor import SIDES
from slam_core.simulation.surface_table import compile_world
from slam_core.types import AnyArray, ByteArray

IMAGE_FORMATS = ("raw", "png", "jpeg")
TYPES = BagTypes()


@dataclass(frozen=True)
class BagOptions:
    """How a simulated bag is stored.

    images: "raw" Image messages, or CompressedImage "png" (lossless) or "jpeg" (quality 90). compact: ToF images in
    16 bits (mm and counts, no intensity): their rounding is a tenth of the sensor's noise. truth: add the true depth of
    the left image on ``ground_truth/depth``. rectified: stereo images without distortion, as ``image_rect``.
    """

    images: str = "raw"
    compact: bool = False
    truth: bool = False
    rectified: bool = False
    storage: str = "mcap"


@click.command()
@click.argument("scenario")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="the bag to write (folder or .mcap)"
)
@click.option("--frames", type=click.IntRange(1), help="render only the first frames")
@click.option("--seed", type=click.IntRange(0), help="another seed than the scenario's: same plan, other building")
@click.option("--storage", type=click.Choice(("mcap", "sqlite3")), default="mcap", show_default=True, help="bag format")
@click.option("--images", type=click.Choice(IMAGE_FORMATS), default="raw", show_default=True, help="stereo images")
@click.option("--compact", is_flag=True, help="ToF images in 16 bits, no intensity")
@click.option("--rectified", is_flag=True, help="rectified stereo images (image_rect) instead of raw ones")
@click.option("--truth", is_flag=True, help="also store the true depth of the left image")
@click.option(
    "--threads", type=click.IntRange(1), help="threads that draw (all processors); the bag does not depend on it"
)
def command(
    scenario: str, output: Path, frames: int | None, seed: int | None, storage: str, images: str, compact: bool,
    rectified: bool, truth: bool, threads: int | None,
) -> None:  # fmt: skip
    """Render SCENARIO (a YAML file, or a name of bags/scenarios) to a bag with ground truth."""
    plan = Scenario.load(scenario)
    if seed is not None:
        plan = replace(plan, seed=seed)
    if frames is not None:
        plan = plan.shortened(frames)
    options = BagOptions(images, compact, truth, rectified, storage)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as progress:
        task = progress.add_task(f"rendering {plan.name}", total=plan.frames * len(plan.agents))
        write_bag(plan, output, options, threads, lambda: progress.advance(task))


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
        Simulator(scenario, k, world, threads, truth=options.truth, rectified=options.rectified)
        for k in range(len(scenario.agents))
    ]
    recorders = {s.scenario.agents[s.agent].name: _Recorder(s, options) for s in agents}
    with BagWriter(output, options.storage) as bag:
        start = min(s.stamp_ns(0) for s in agents)
        transforms = [t for r in recorders.values() for t in r.static_transforms(start)]
        bag.write("/tf_static", TYPES.TFMessage(transforms=transforms), start)
        for frame in merge(*(s.run() for s in agents), key=lambda f: f.stamp_ns):
            for topic, message, stamp in recorders[frame.agent].messages(frame):
                bag.write(topic, message, stamp)
            advance()


class _Recorder:
    """Turns the frames of one agent into messages."""

    def __init__(self, simulator: Simulator, options: BagOptions) -> None:
        self._simulator, self._options = simulator, options
        self._agent = simulator.scenario.agents[simulator.agent].name
        self._infos = dict(zip(SIDES, simulator.stereo.infos, strict=True))

    def static_transforms(self, stamp: int) -> list[Message]:
        """Where the sensors sit on the rig."""
        s = self._simulator
        T_rig_right = s.T_rig_left.copy()
        T_rig_right[:3, 3] -= s.stereo.stereo.baseline * np.array([0.0, 1.0, 0.0])
        mountings = []
        if "stereo" in s.scenario.sensors:
            mountings += [("stereo_left_optical_frame", s.T_rig_left), ("stereo_right_optical_frame", T_rig_right)]
        if "tof" in s.scenario.sensors:
            mountings.append(("tof_optical_frame", s.tof.T_rig_tof))
        base = self._name("base_link")
        return [transform_message(TYPES, stamp, base, self._name(frame), T) for frame, T in mountings]

    def messages(self, frame: SimulatedFrame) -> Iterator[tuple[str, Message, int]]:
        """Topic, message and time of recording of all that one frame brings."""
        for sample in frame.imu:
            yield self._topic("imu"), imu_message(TYPES, self._name("base_link"), sample), sample.stamp_ns
        now = frame.stamp_ns
        truth = pose_stamped_message(TYPES, now, "world", frame.T_world_rig)
        yield self._topic("ground_truth/pose"), truth, now
        # Not base_link itself: a frame has one parent, and the estimators give it theirs.
        moving = transform_message(TYPES, now, "world", self._name("ground_truth/base_link"), frame.T_world_rig)
        yield "/tf", TYPES.TFMessage(transforms=[moving]), now
        if frame.left is not None and frame.right is not None:
            yield from self._stereo("left", frame.left, now, now)
            yield from self._stereo("right", frame.right, frame.right_stamp_ns, now)
        if frame.tof is not None:
            yield from self._tof(frame)
        if frame.truth is not None:
            header = header_message(TYPES, now, self._name("stereo_left_optical_frame"))
            yield self._topic("ground_truth/depth"), image_message(TYPES, header, frame.truth.depth), now

    def _stereo(self, side: str, image: ByteArray, stamp: int, now: int) -> Iterator[tuple[str, Message, int]]:
        header = header_message(TYPES, stamp, self._name(f"stereo_{side}_optical_frame"))
        yield self._topic(f"stereo/{side}/camera_info"), camera_info_message(TYPES, header, self._infos[side]), now
        topic = self._topic(f"stereo/{side}/image_{'rect' if self._options.rectified else 'raw'}")
        if self._options.images == "raw":
            yield topic, image_message(TYPES, header, image), now
        else:
            yield f"{topic}/compressed", _compressed(header, image, self._options.images), now

    def _tof(self, frame: SimulatedFrame) -> Iterator[tuple[str, Message, int]]:
        assert frame.tof is not None
        now, compact = frame.stamp_ns, self._options.compact
        header = header_message(TYPES, now, self._name("tof_optical_frame"))
        info = CameraInfo(self._simulator.tof.camera)
        yield self._topic("tof/camera_info"), camera_info_message(TYPES, header, info), now
        images = {"range": frame.tof.range, "amplitude": frame.tof.amplitude, "intensity": frame.tof.intensity}
        if compact:
            del images["intensity"]
        for name, image in images.items():
            stored: AnyArray = image
            if compact:
                stored = np.rint(image * (1000.0 if name == "range" else 1.0)).astype(np.uint16)
            yield self._topic(f"tof/{name}/image_raw"), image_message(TYPES, header, stored), now

    def _topic(self, name: str) -> str:
        return f"/{self._agent}/{name}" if self._agent else f"/{name}"

    def _name(self, frame: str) -> str:
        return f"{self._agent}/{frame}" if self._agent else frame


def _compressed(header: Message, image: ByteArray, kind: str) -> Message:
    suffix, setting = (
        (".png", [cv2.IMWRITE_PNG_COMPRESSION, 3]) if kind == "png" else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 90])
    )
    ok, data = cv2.imencode(suffix, image, setting)
    if not ok:
        raise ValueError(f"OpenCV cannot encode {kind} images")
    return compressed_image_message(TYPES, header, data.tobytes(), kind)
