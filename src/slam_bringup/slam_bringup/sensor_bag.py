"""What a bag holds for the estimators: per agent, paired and decoded images, depth, IMU, extrinsics, ground truth.

    with SensorBag(path) as bag:
        for reading in bag.readings():
            ...  # StereoReading, DepthReading or ImuReading, in the order of the bag

Topics are those of the nodes, below each agent's namespace:

- ``stereo/{left,right}/image_raw`` (or ``image_rect``; also ``.../compressed``) with ``camera_info``;
- ``tof/range/image_raw`` (along the ray) or ``tof/depth/image_raw`` (along z, any depth camera) with
  ``tof/camera_info`` and, where there are any, ``tof/{amplitude,intensity}/image_raw``;
- ``imu`` and ``ground_truth/pose``.

Extrinsics come from ``tf_static``. The calibration of a bag is constant: the first info of each camera counts.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Self

import numpy as np

from slam_bringup.bag import BagReader
from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray
from slam_core.messages import (
    camera_info_from_message,
    grey_from_message,
    image_from_message,
    imu_from_message,
    pose_from_message,
    stamp_ns,
    transform_from_message,
)
from slam_core.messages.base import Message
from slam_core.synchronizer import ExactSynchronizer
from slam_core.trajectory import Trajectory
from slam_core.types import AnyArray, ByteArray, ImuSample

_LEFT = ("stereo/left/image_raw", "stereo/left/image_rect", "stereo/left/image_raw/compressed")
_MEASUREMENTS = {"tof/range/image_raw": "range", "tof/depth/image_raw": "depth"}
_MARKERS = (*_LEFT, *_MEASUREMENTS)


@dataclass(frozen=True, eq=False)
class StereoReading:
    """A pair of grey images uint8 (height, width); ``rectified`` says whether they came rectified."""

    agent: str
    stamp_ns: int
    left: ByteArray
    right: ByteArray
    rectified: bool


@dataclass(frozen=True, eq=False)
class DepthReading:
    """Images of a ToF or depth camera as recorded (uint16 mm or float32 m), with amplitude and intensity or None."""

    agent: str
    stamp_ns: int
    image: AnyArray
    amplitude: AnyArray | None
    intensity: AnyArray | None


@dataclass(frozen=True, eq=False)
class ImuReading:
    """An IMU sample in the axes of base_link."""

    agent: str
    sample: ImuSample


Reading = StereoReading | DepthReading | ImuReading


@dataclass(frozen=True, eq=False)
class AgentSensors:
    """What one agent carries. Frames and infos are None where there is no such sensor.

    ``measurement``: "range" along the ray or "depth" along z. ``frames``: the static transforms between its frames.
    """

    agent: str
    left: CameraInfo | None
    right: CameraInfo | None
    tof: CameraInfo | None
    measurement: str
    frames: FrameTree
    left_frame: str = ""
    tof_frame: str = ""
    base_frame: str = "base_link"
    topics: dict[str, str] = field(default_factory=dict)
    """Role ("left", "right", "depth", "amplitude", "intensity", "imu", "ground_truth") to the bag's topic."""

    def transform(self, target: str, source: str) -> FloatArray:
        """T_target_source between "base", "left" and "tof"; ValueError if the bag does not know it."""
        names = {"base": self.base_frame, "left": self.left_frame, "tof": self.tof_frame}
        return self.frames.lookup(names[target], names[source])


class SensorBag:
    """A bag as a stream of readings; use it in a ``with`` block.

    Raises
    ------
    ValueError
        If the bag cannot be read or holds no camera.
    """

    def __init__(self, path: Path) -> None:
        self.reader = BagReader(path)
        self.unpaired = 0
        """Images without a partner of their stamp, of the last :meth:`readings`."""

    def __enter__(self) -> Self:
        self.reader.__enter__()
        try:
            self.agents = self._find_agents()
            self.sensors = self._find_sensors()
        except BaseException:
            self.reader.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.__exit__()

    def readings(self) -> Generator[Reading, None, None]:
        """Every reading in the order of the bag; of those with one stamp IMU and depth come before the stereo pair.

        What helps a frame thus comes before it, as at the node, which waits for it.
        """
        for _, together in groupby(self._in_order_of_arrival(), key=_stamp):
            yield from sorted(together, key=_rank)

    def _in_order_of_arrival(self) -> Iterator[Reading]:
        """A pair comes when its last image does."""
        pairing = {agent: _AgentPairing(sensors) for agent, sensors in self.sensors.items()}
        route = {t: (agent, role) for agent, s in self.sensors.items() for role, t in s.topics.items()}
        wanted = [topic for topic, (_, role) in route.items() if role != "ground_truth"]
        for topic, _, message in self.reader.messages(wanted):
            agent, role = route[topic]
            yield from pairing[agent].add(role, message)
        self.unpaired = sum(p.unpaired for p in pairing.values())

    def count(self, agent: str, role: str) -> int:
        """Messages of a role ("left", "depth", "imu", ...) of an agent; 0 if there is no such topic."""
        topic = self.sensors[agent].topics.get(role)
        return self.reader.topics[topic].count if topic else 0

    def ground_truth(self, agent: str) -> Trajectory | None:
        """Poses T_world_base of the agent, without covariance; None if the bag has none."""
        topic = self.sensors[agent].topics.get("ground_truth")
        if topic is None:
            return None
        poses = {stamp_ns(m): pose_from_message(m.pose) for _, _, m in self.reader.messages([topic])}
        stamps = sorted(poses)
        return Trajectory(np.array(stamps, dtype=np.int64), np.stack([poses[s] for s in stamps])) if stamps else None

    def _find_agents(self) -> tuple[str, ...]:
        found = {t[1 : -len(m)].rstrip("/") for t in self.reader.topics for m in _MARKERS if t.endswith(f"/{m}")}
        if not found:
            topics = ", ".join(self.reader.topics) or "none"
            raise ValueError(f"{self.reader.path} has no stereo or depth images; its topics: {topics}")
        return tuple(sorted(found))

    def _find_sensors(self) -> dict[str, AgentSensors]:
        tree = self._read_frames()
        return {agent: self._sensors_of(agent, tree) for agent in self.agents}

    def _sensors_of(self, agent: str, tree: FrameTree) -> AgentSensors:
        topics = self._topics_of(agent)
        left, left_frame = self._camera_info(agent, "stereo/left/camera_info", "left" in topics)
        right, _ = self._camera_info(agent, "stereo/right/camera_info", "right" in topics)
        tof, tof_frame = self._camera_info(agent, "tof/camera_info", "depth" in topics)
        own_base = f"{agent}/base_link"
        base = own_base if own_base in tree else "base_link"
        measurement = "range" if topics.get("depth", "").endswith("tof/range/image_raw") else "depth"
        return AgentSensors(agent, left, right, tof, measurement, tree, left_frame, tof_frame, base, topics)

    def _topics_of(self, agent: str) -> dict[str, str]:
        candidates = {
            "left": _LEFT, "right": tuple(t.replace("left", "right") for t in _LEFT), "depth": tuple(_MEASUREMENTS),
            "amplitude": ("tof/amplitude/image_raw",), "intensity": ("tof/intensity/image_raw",), "imu": ("imu",),
            "ground_truth": ("ground_truth/pose",),
        }  # fmt: skip
        known = self.reader.topics
        found = {}
        for role, names in candidates.items():
            present = [_join(agent, name) for name in names if known.get(_join(agent, name))]
            if present:
                found[role] = present[0]
        return found

    def _camera_info(self, agent: str, name: str, needed: bool) -> tuple[CameraInfo | None, str]:
        if not needed:
            return None, ""
        topic = _join(agent, name)
        for _, _, message in self.reader.messages([topic]):
            return camera_info_from_message(message), message.header.frame_id
        raise ValueError(f"{self.reader.path} has images but no camera info on {topic}")

    def _read_frames(self) -> FrameTree:
        tree = FrameTree()
        topics = [t for t in self.reader.topics if t.endswith("/tf_static")]
        for _, _, message in self.reader.messages(topics):
            for transform in message.transforms:
                tree.add(*transform_from_message(transform))
        return tree


class _AgentPairing:
    """Pairs one agent's messages by exact stamp."""

    def __init__(self, sensors: AgentSensors) -> None:
        self._sensors = sensors
        self._ready: list[Reading] = []
        has_stereo = {"left", "right"} <= sensors.topics.keys()
        depth_roles = [role for role in ("depth", "amplitude", "intensity") if role in sensors.topics]
        self._stereo = ExactSynchronizer[Message](("left", "right") if has_stereo else (), self._on_stereo)
        self._depth = ExactSynchronizer[Message](depth_roles, self._on_depth)
        self._depth_roles = depth_roles

    @property
    def unpaired(self) -> int:
        waiting = [*self._stereo.waiting.values(), *self._depth.waiting.values()]
        return self._stereo.unpaired + self._depth.unpaired + sum(waiting)

    def add(self, role: str, message: Message) -> list[Reading]:
        """The readings that this message completes."""
        self._ready = []
        if role == "imu":
            self._on_imu(message)
        elif role in ("left", "right"):
            self._stereo.add(role, stamp_ns(message), message)
        else:
            self._depth.add(role, stamp_ns(message), message)
        return self._ready

    def _on_stereo(self, stamp: int, messages: tuple[Message, ...]) -> None:
        left, right = (grey_from_message(m) for m in messages)
        rectified = self._sensors.topics["left"].endswith("image_rect")
        self._ready.append(StereoReading(self._sensors.agent, stamp, left, right, rectified))

    def _on_depth(self, stamp: int, messages: tuple[Message, ...]) -> None:
        images = dict(zip(self._depth_roles, (image_from_message(m) for m in messages), strict=True))
        reading = DepthReading(
            self._sensors.agent, stamp, images["depth"], images.get("amplitude"), images.get("intensity")
        )
        self._ready.append(reading)

    def _on_imu(self, message: Message) -> None:
        sample = imu_from_message(message)
        R = self._sensors.frames.lookup(self._sensors.base_frame, message.header.frame_id)[:3, :3]
        rotated = ImuSample(sample.stamp_ns, R @ sample.angular_velocity, R @ sample.linear_acceleration)
        self._ready.append(ImuReading(self._sensors.agent, rotated))


def _stamp(reading: Reading) -> int:
    return reading.sample.stamp_ns if isinstance(reading, ImuReading) else reading.stamp_ns


def _rank(reading: Reading) -> int:
    return (ImuReading, DepthReading, StereoReading).index(type(reading))


def _join(agent: str, name: str) -> str:
    return f"/{agent}/{name}" if agent else f"/{name}"
