# SPDX-License-Identifier: Apache-2.0
"""Evidence for the checks: stamps of every message, calibration, frames, and some of the images of each agent.

    messages of a bag -> streams (all stamps) -> sample (three bursts of consecutive images) -> decoded images

Unlike :class:`slam_bags.reading.sensor_bag.SensorBag` it takes any bag, for what is missing is a finding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slam_bags.nodes.pacing import header_stamp_ns
from slam_bags.reading.rig_cameras import rigs_of
from slam_bags.reading.sensor_topics import BagNames, find_agents, is_rectified, topics_of, topics_on_rig
from slam_bags.storage.bag import BagReader, TopicInfo
from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray
from slam_core.messages import (
    camera_info_from_message,
    grey_from_message,
    imu_from_message,
    metres_from_message,
    odometry_from_message,
    picture_from_message,
    position_from_message,
    pressure_from_message,
    transform_from_message,
)
from slam_core.messages.base import Message
from slam_core.types import AnyArray, OdometryReading, PositionReading, PressureReading

Stamps = npt.NDArray[np.int64]
BURSTS, BURST = 3, 12
"""Bursts of consecutive images that are looked at, and images in each."""

_ACCOMPANYING = ("imu", "odometry", "position", "pressure")
_STREAMED = ("left", "right", "depth", "range", "amplitude", "intensity", *_ACCOMPANYING)
"""Roles of which all stamps are looked at."""
_PICTURES = ("left", "right", "depth", "range", "amplitude")
_INFOS = {"left": "left_info", "right": "right_info", "depth": "tof_info", "range": "tof_info"}


@dataclass(frozen=True, eq=False)
class Stream:
    """All messages of a topic: header stamps and times of recording, ns, in the order of the bag."""

    topic: str
    info: TopicInfo
    stamps: Stamps
    times: Stamps
    largest_bytes: int


@dataclass(frozen=True, eq=False)
class Calibration:
    """The first camera info of a camera; ``error`` says why there is none."""

    topic: str
    info: CameraInfo | None = None
    frame: str = ""
    error: str = ""


@dataclass(eq=False)
class Evidence:
    """One agent. Roles as in :mod:`slam_bags.reading.sensor_topics`; ``depth`` may be a range along the ray.

    images: decoded sample by role and stamp; depth and range in m. faults: messages that could not be decoded, by topic
    with the first reason. imu: rows of stamp s, angular velocity rad/s, specific force m/s2, in the IMU's axes.
    odometry, positions, pressures: every pose, position in a fixed frame, and pressure that could be read.
    rig, camera: namespace of the rig, and name there, of one of several cameras; "" otherwise.
    """

    agent: str
    topics: Mapping[str, str]
    streams: dict[str, Stream]
    calibrations: dict[str, Calibration]
    frames: FrameTree
    base_frame: str
    image_frames: dict[str, str] = field(default_factory=dict)
    images: dict[str, dict[int, AnyArray]] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)
    imu: FloatArray = field(default_factory=lambda: np.empty((0, 7)))
    odometry: list[OdometryReading] = field(default_factory=list)
    positions: list[PositionReading] = field(default_factory=list)
    pressures: list[PressureReading] = field(default_factory=list)
    rig: str = ""
    camera: str = ""

    @property
    def leader(self) -> Stream:
        """The stream of the left images, or of the depth images without a left camera."""
        return self.streams["left" if "left" in self.streams else self.depth_role]

    @property
    def depth_role(self) -> str:
        """The role of the depth camera's images: depth along z, range along the ray, or "" without one."""
        return next((role for role in ("depth", "range") if role in self.topics), "")

    def name(self, role: str) -> str:
        """The topic of a role."""
        return self.topics[role]

    def rectified_info(self, role: str) -> CameraInfo | None:
        """Calibration of a camera's images as they are in the bag."""
        calibration = self.calibrations.get(role)
        if calibration is None or calibration.info is None:
            return None
        info = calibration.info
        return CameraInfo(info.rectified, P=info.P) if is_rectified(self.topics[role]) else info

    def pairs(self) -> list[tuple[int, AnyArray, AnyArray]]:
        """Sampled pairs: the left image's stamp, the left image, and the right image nearest in time."""
        return [(stamp, left, right) for stamp, left, right in self._nearest("left", "right")]

    def depth_beside_left(self) -> dict[int, AnyArray]:
        """The depth image nearest in time to each sampled left image, by its stamp."""
        return {stamp: image for stamp, _, image in self._nearest("left", self.depth_role)}

    def _nearest(self, first: str, second: str) -> list[tuple[int, AnyArray, AnyArray]]:
        others = self.images.get(second, {})
        stamps = np.array(sorted(others), dtype=np.int64)
        if not len(stamps):
            return []
        found = []
        for stamp, image in sorted(self.images.get(first, {}).items()):
            found.append((stamp, image, others[int(stamps[np.argmin(np.abs(stamps - stamp))])]))
        return found


def gather(path: Path, names: BagNames | None = None, *, messages: int | None = None) -> list[Evidence]:
    """Evidence of every agent of a bag; of its first ``messages`` messages, or of all.

    Raises
    ------
    ValueError
        If the bag cannot be read, holds no images under known names, or lacks a topic that ``names`` gives.
    """
    names = names or BagNames()
    with BagReader(path) as bag:
        agents = tuple(names.rig.topics) or find_agents(bag.topics, names.topics)
        if not agents:
            present = ", ".join(f"{n} ({i.type_name})" for n, i in bag.topics.items()) or "none"
            raise ValueError(
                f"{path} has no images under the names of the nodes: say which topics they are (--topic left=/... "
                f"--topic right=/... or --topic depth=/...). Its topics: {present}"
            )
        frames = _read_frames(bag)
        for given in names.rig.transforms:
            frames.add(given.parent, given.child, given.T)
        roles = {agent: topics_of(agent, bag.topics, names.rig.topics.get(agent, names.topics)) for agent in agents}
        calibrations = {
            agent: {role: _calibration(bag, own[info]) for role, info in _INFOS.items() if role in own}
            for agent, own in roles.items()
        }
        image_frames = {
            agent: [c.frame for role, c in own.items() if role != "right" and c.frame]
            for agent, own in calibrations.items()
        }
        rigs = {"": agents} if names.rig.topics else rigs_of(image_frames, frames, bag.topics)
        found = {}
        for rig, cameras in rigs.items():
            if len(cameras) > 1 or names.rig.topics:
                roles |= topics_on_rig(rig, {name: roles[name] for name in cameras}, bag.topics, names.topics)[0]
            usual = [f for f in (f"{rig}/base_link", "base_link") if f in frames]
            base = names.base_frame or (usual[0] if usual else "")
            for agent in cameras:
                topics = roles[agent]
                streams = _streams(bag, {role: topics[role] for role in _STREAMED if role in topics}, messages)
                own = Evidence(agent, topics, streams, calibrations[agent], frames, base)
                own.rig, own.camera = (rig, agent.rpartition("/")[2]) if len(cameras) > 1 else ("", "")
                _decode_sample(bag, own, messages)
                found[agent] = own
        return [found[agent] for agent in agents]


def _streams(bag: BagReader, topics: Mapping[str, str], messages: int | None) -> dict[str, Stream]:
    rows: dict[str, list[tuple[int, int, int]]] = {topic: [] for topic in topics.values()}
    for count, (topic, time, data) in enumerate(bag.raw(list(rows))):
        if messages is not None and count >= messages:
            break
        rows[topic].append((header_stamp_ns(data), time, len(data)))
    arrays = {topic: np.array(r, dtype=np.int64).reshape(-1, 3) for topic, r in rows.items()}
    return {
        role: Stream(topic, bag.topics[topic], a[:, 0], a[:, 1], int(a[:, 2].max(initial=0)))
        for role, topic in topics.items()
        for a in [arrays[topic]]
    }


def _calibration(bag: BagReader, topic: str) -> Calibration:
    if topic not in bag.topics:
        return Calibration(topic, error="no such topic")
    for _, _, message in bag.messages([topic]):
        try:
            return Calibration(topic, camera_info_from_message(message), message.header.frame_id)
        except ValueError as error:
            return Calibration(topic, frame=message.header.frame_id, error=str(error))
    return Calibration(topic, error="no message")


def _read_frames(bag: BagReader) -> FrameTree:
    tree = FrameTree()
    for _, _, message in bag.messages([t for t in bag.topics if t.endswith("/tf_static")]):
        for transform in message.transforms:
            tree.add(*transform_from_message(transform))
    return tree


def _decode_sample(bag: BagReader, evidence: Evidence, messages: int | None) -> None:
    """Bursts of the left camera, or of the depth camera without one, and all that is nearest to them in time.

    A bag's first ``messages`` are one burst.
    """
    leader = "left" if "left" in evidence.streams else evidence.depth_role
    stamps = evidence.streams[leader].stamps
    wanted = _bursts(stamps) if messages is None else stamps[:BURST]
    chosen = {
        evidence.topics[role]: _nearest_stamps(evidence.streams[role].stamps, wanted)
        for role in _PICTURES
        if role in evidence.streams
    }
    role_of = {topic: role for role, topic in evidence.topics.items() if role in _STREAMED}
    samples: list[FloatArray] = []
    accompanying = {evidence.topics[role]: role for role in _ACCOMPANYING if role in evidence.streams}
    last = max(max(stamps, default=0) for stamps in chosen.values())
    for count, (topic, _, data) in enumerate(bag.raw([*chosen, *accompanying])):
        if messages is not None and count >= messages:
            break
        stamp = header_stamp_ns(data)
        if stamp > last if topic in accompanying else stamp not in chosen[topic]:
            continue
        try:
            message = bag.decode(bag.topics[topic].type_name, data)
            if topic in accompanying:
                evidence.image_frames.setdefault(accompanying[topic], _frame_of(message))
            if accompanying.get(topic) == "odometry":
                evidence.odometry.append(odometry_from_message(message))
            elif accompanying.get(topic) == "position":
                evidence.positions.append(position_from_message(message))
            elif accompanying.get(topic) == "pressure":
                evidence.pressures.append(pressure_from_message(message))
            elif topic in accompanying:
                sample = imu_from_message(message)
                samples.append(np.array([stamp / 1e9, *sample.angular_velocity, *sample.linear_acceleration]))
            else:
                _keep_image(evidence, role_of[topic], stamp, message)
        except ValueError as error:
            evidence.faults.setdefault(topic, str(error))
    if samples:
        evidence.imu = np.stack(samples)


def _frame_of(message: Message) -> str:
    """The frame that moves, of an odometry, or in whose axes an IMU reports."""
    return str(getattr(message, "child_frame_id", "") or message.header.frame_id)


def _keep_image(evidence: Evidence, role: str, stamp: int, message: Message) -> None:
    decode = {"depth": metres_from_message, "range": metres_from_message, "amplitude": picture_from_message}
    evidence.images.setdefault(role, {})[stamp] = decode.get(role, grey_from_message)(message)
    evidence.image_frames.setdefault(role, message.header.frame_id)


def _bursts(stamps: Stamps) -> Stamps:
    """Stamps of three bursts of consecutive messages, spread over the recording."""
    if len(stamps) <= BURSTS * BURST:
        return stamps
    starts = np.linspace(0.1, 0.9, BURSTS) * (len(stamps) - BURST)
    return np.concatenate([stamps[int(start) : int(start) + BURST] for start in starts])


def _nearest_stamps(stamps: Stamps, wanted: Stamps) -> set[int]:
    ordered = np.sort(stamps)
    if not len(ordered):
        return set()
    after = np.searchsorted(ordered, wanted).clip(1, max(len(ordered) - 1, 1))
    candidates = np.stack([ordered[after - 1], ordered[np.minimum(after, len(ordered) - 1)]])
    best = np.abs(candidates - wanted).argmin(axis=0)
    return {int(s) for s in candidates[best, np.arange(len(wanted))]}
