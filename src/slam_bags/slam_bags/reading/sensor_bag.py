# SPDX-License-Identifier: Apache-2.0
"""A bag's content for the estimators: per agent, paired and decoded images, depth, IMU, extrinsics, ground truth.

    with SensorBag(path) as bag:
        for reading in bag.readings():
            ...  # StereoReading, DepthReading, LaserReading, ImuReading, ... in the order of the bag

Topics are those of the nodes, or given by role, see :mod:`slam_bags.reading.sensor_topics`:

- ``stereo/{left,right}/image_raw`` (or ``image_rect``; also ``.../compressed``) with ``camera_info``;
- ``tof/range/image_raw`` (along the ray) or ``tof/depth/image_raw`` (along z, any depth camera) with
  ``tof/camera_info`` and, where there are any, ``tof/{amplitude,intensity}/image_raw``, and ``tof/color/image_raw``
  in the pixels of the depth image: colours of the dense model, and the picture that features come from where there is
  no other;
- ``scan`` of a laser scanner, ``imu``, ``odometry``, ``position``, ``pressure`` and ``ground_truth/pose``;
- ``mask`` of the rectified left image and ``tof/mask`` of the depth image: pixels that are not zero are not used.

Several cameras of one rig (:mod:`slam_bags.reading.rig_cameras`) are read as an agent each, ``rigs`` says which belong
together. Extrinsics come from ``tf_static``. The calibration of a bag is constant: the first info of each camera
counts, and images under another one are left out. So is a message that is broken, has no partner or an odd stamp; all
are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Self, TypeVar

import numpy as np

from slam_bags.reading.agent_stream import AgentStream
from slam_bags.reading.extrinsics import StaticTransform
from slam_bags.reading.left_out import LeftOut
from slam_bags.reading.reading_times import ReadingTimes, Stamps
from slam_bags.reading.readings import (
    IMAGE_ROLES,
    INFO_ROLES,
    MASK_ROLES,
    ROLES_READ,
    AgentPairing,
    AgentSensors,
    AirReading,
    ColourReading,
    DepthReading,
    FixReading,
    ImuReading,
    InfoReading,
    LaserReading,
    MaskReading,
    PoseReading,
    Reading,
    SessionStart,
    StereoReading,
)
from slam_bags.reading.rig_calibration import RigCalibration
from slam_bags.reading.rig_cameras import rigs_of
from slam_bags.reading.rig_sensors import heard_cameras, on_rig
from slam_bags.reading.sensor_topics import BagNames, find_agents, is_rectified, join, other_cameras, topics_of
from slam_bags.storage.bag import BagReader
from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.messages import (
    camera_info_from_message,
    pose_from_message,
    stamp_ns,
    transform_from_message,
)
from slam_core.messages.base import Message
from slam_core.nodes.calibration_watch import CalibrationWatch
from slam_core.trajectory import Trajectory

R = TypeVar("R", bound=Reading | InfoReading)

_RANKS = (
    SessionStart, InfoReading, ImuReading, PoseReading, FixReading, AirReading, ColourReading, MaskReading,
    DepthReading, LaserReading, StereoReading,
)  # fmt: skip
_LEADER: dict[type[Reading], str] = {StereoReading: "left", DepthReading: "depth"}
"""Role of the first image of each kind of reading of a camera."""
_IMAGES_OF: dict[str, type[Reading]] = {"left": StereoReading, "right": StereoReading, "depth": DepthReading}
_ROLES_OF_IMAGES = (*IMAGE_ROLES, *MASK_ROLES.values())
_AFTER_STAMP = 12
"""Bytes of a message up to its stamp's end: encapsulation, seconds, nanoseconds."""


class SensorBag:
    """A bag as a stream of readings; use it in a ``with`` block.

    Parameters
    ----------
    path
        The bag.
    names
        Topics and frame of the rig where they are not named like the nodes' own.

    Raises
    ------
    ValueError
        If the bag cannot be read or holds no camera.
    """

    def __init__(self, path: Path, names: BagNames | None = None) -> None:
        self.reader = BagReader(path)
        self.times = ReadingTimes()
        """Stamps and times of what the last :meth:`readings` passed."""
        self._left_out = LeftOut()
        self._warnings: list[str] = []
        self._names = names or BagNames()
        self._true_poses: dict[str, list[bytes]] = {}

    def __enter__(self) -> Self:
        self.reader.__enter__()
        self.rigs: dict[str, tuple[str, ...]] = {}
        try:
            self.agents = self._find_agents()
            self.sensors = self._find_sensors()
            used = {topic for sensors in self.sensors.values() for topic in sensors.topics.values()}
            if unused := other_cameras(used, {name: info.type_name for name, info in self.reader.topics.items()}):
                self._warnings.append(f"images that are not used, of other cameras: {', '.join(unused)} (--topic)")
        except BaseException:
            self.reader.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.__exit__()

    def readings(self, *, colours: bool = False) -> Generator[Reading, None, None]:
        """Every reading in the order of the bag; of those with one stamp the stereo pair comes last.

        What helps a frame thus comes before it, as at the node, which waits for it. ``colours``: the colour pictures
        too, which only the dense model needs.
        """
        self._left_out, self.times = LeftOut(), ReadingTimes()
        watches = {agent: self._calibrations(sensors) for agent, sensors in self.sensors.items()}
        for reading in _with_ranks(self._in_order_of_arrival(colours)):
            if isinstance(reading, InfoReading):
                watches[reading.agent][_IMAGES_OF[reading.camera]].hear(reading.camera, reading.info)
                continue
            guard = watches[reading.agent].get(type(reading))
            if guard is not None and (diagnostic := guard.diagnostic):
                topic = self.sensors[reading.agent].topics[_LEADER[type(reading)]]
                self._left_out.add(f"images on {topic} under another calibration", warning=f"{topic}: {diagnostic}")
                continue
            self.times.add(reading)
            yield reading

    def images_at(self, wanted: Mapping[str, Stamps]) -> Generator[Reading, None, None]:
        """The stereo and depth readings with some stamps, by agent, their masks, and perhaps others.

        After :meth:`readings`.

        Only the parts of the bag that hold them are unpacked, as ``times`` has it.
        """
        given = set()
        for reading in _with_ranks(self._at(wanted)):
            key = (reading.agent, type(reading), reading.stamp_ns)
            if isinstance(reading, StereoReading | DepthReading | MaskReading) and key not in given:
                given.add(key)
                yield reading

    def _in_order_of_arrival(self, colours: bool) -> Iterator[Reading | InfoReading]:
        """A pair comes when its last image does."""
        left_out, times = self._left_out, self.times
        streams = {agent: AgentStream(sensors, left_out) for agent, sensors in self.sensors.items()}
        route = self._route([role for role in ROLES_READ if colours or role != "color"])
        infos = self._route([role for role in INFO_ROLES if self._names.calibration.info(_file_of(role)) is None])
        types = {name: info.type_name for name, info in self.reader.topics.items()}
        true_poses: dict[str, list[bytes]] = {topic: [] for topic in self._truth_topics()}
        newest: dict[str, bytes] = {}
        for topic, recorded_ns, data in self.reader.raw({*route, *infos, *true_poses}):
            if topic in true_poses:
                true_poses[topic].append(data)
                continue
            if topic in infos and newest.get(topic) == data[_AFTER_STAMP:]:
                continue
            try:
                message = self.reader.decode(types[topic], data)
            except ValueError as error:
                left_out.unusable(topic, error)
                continue
            if topic in infos:
                newest[topic] = data[_AFTER_STAMP:]
                yield from self._infos(infos[topic], topic, message)
            for agent, role in route.get(topic, ()):
                if role in _ROLES_OF_IMAGES:
                    times.add_image(agent, stamp_ns(message), recorded_ns)
                yield from streams[agent].add(role, message)
        for stream in streams.values():
            yield from stream.finish()
        self._true_poses = true_poses
        times.is_whole = self.reader.is_indexed

    def _infos(self, route: Sequence[tuple[str, str]], topic: str, message: Message) -> Iterator[InfoReading]:
        """A camera info for each agent and camera that it is of."""
        for agent, role in route:
            camera = INFO_ROLES[role]
            try:
                info = _as_recorded(camera_info_from_message(message), camera, self.sensors[agent].topics[camera])
                yield InfoReading(agent, stamp_ns(message), camera, info)
            except ValueError as error:
                self._left_out.unusable(topic, error)

    def _calibrations(self, sensors: AgentSensors) -> dict[type[Reading], CalibrationWatch]:
        """Watches over an agent's stereo and depth camera, which know the calibrations in use."""
        watches: dict[type[Reading], CalibrationWatch] = {kind: CalibrationWatch() for kind in _LEADER}
        for camera, info in (("left", sensors.left), ("right", sensors.right), ("depth", sensors.tof)):
            if info is not None:
                watches[_IMAGES_OF[camera]].hear(camera, info)
        return watches

    def _at(self, wanted: Mapping[str, Stamps]) -> Iterator[Reading]:
        pairing = {agent: AgentPairing(self.sensors[agent], LeftOut()) for agent in wanted}
        route = self._route(_ROLES_OF_IMAGES)
        types = {name: info.type_name for name, info in self.reader.topics.items()}
        for topic, _, data in self.reader.raw(route, self.times.spans(wanted)):
            for agent, role in route[topic]:
                if agent in pairing:
                    with suppress(ValueError):  # told by the first reading
                        yield from pairing[agent].add(role, self.reader.decode(types[topic], data))

    def _route(self, roles: Sequence[str]) -> dict[str, list[tuple[str, str]]]:
        """Agents and roles that messages of each topic are for."""
        route: dict[str, list[tuple[str, str]]] = {}
        for agent, sensors in self.sensors.items():
            for role in (role for role in roles if role in sensors.topics):
                route.setdefault(sensors.topics[role], []).append((agent, role))
        return route

    def _truth_topics(self) -> set[str]:
        """Topics of true poses: read along with the rest, for another pass would unpack the whole bag."""
        return {s.topics["ground_truth"] for s in self.sensors.values() if "ground_truth" in s.topics}

    @property
    def calibration(self) -> RigCalibration:
        """The calibration that a user gives instead of the bag's."""
        return self._names.calibration

    @property
    def mountings(self) -> tuple[StaticTransform, ...]:
        """Static transforms of a rig that a user gives beside the bag's."""
        return self._names.rig.transforms

    @property
    def left_out(self) -> Counter[str]:
        """Messages that the last :meth:`readings` left out, by reason."""
        return self._left_out.counts

    @property
    def warnings(self) -> list[str]:
        """Warnings about this bag, as far as it has been read."""
        return [*self._warnings, *self._left_out.warnings, *[self.reader.warning] * bool(self.reader.warning)]

    def first_of(self, agent: str) -> AgentSensors:
        """The sensors of an agent, or of the first camera of a rig."""
        return self.sensors[agent if agent in self.sensors else self.rigs[agent][0]]

    def count(self, agent: str, role: str) -> int:
        """Messages of a role ("left", "depth", "imu", ...) of an agent or a rig; 0 if there is no such topic."""
        topic = self.first_of(agent).topics.get(role)
        return self.reader.topics[topic].count if topic else 0

    def ground_truth(self, agent: str) -> Trajectory | None:
        """Poses T_world_base of the agent or rig, without covariance; None if the bag has none."""
        topic = self.first_of(agent).topics.get("ground_truth")
        if topic is None:
            return None
        if topic not in self._true_poses:  # the bag has not been read to its end
            self._true_poses[topic] = [data for _, _, data in self.reader.raw([topic])]
        type_name = self.reader.topics[topic].type_name
        messages = (self.reader.decode(type_name, data) for data in self._true_poses[topic])
        poses = {stamp_ns(m): pose_from_message(m.pose) for m in messages}
        stamps = sorted(poses)
        return Trajectory(np.array(stamps, dtype=np.int64), np.stack([poses[s] for s in stamps])) if stamps else None

    def _find_agents(self) -> tuple[str, ...]:
        if self._names.rig.topics:
            heard, warnings = heard_cameras(self._names.rig, self._counts() if self.reader.is_indexed else {})
            self._warnings += warnings
            return heard
        found = find_agents(self.reader.topics, self._names.topics)
        if not found:
            topics = ", ".join(f"{name} ({info.type_name})" for name, info in self.reader.topics.items()) or "none"
            raise ValueError(
                f"{self.reader.path} has no stereo or depth images under the names of the nodes; say which topics they "
                f"are: --topic left=/... --topic right=/... or --topic depth=/... Its topics: {topics}"
            )
        return found

    def _find_sensors(self) -> dict[str, AgentSensors]:
        tree = self._read_frames()
        if self._names.calibration.is_given and len(self.agents) > 1:
            raise ValueError(f"a calibration is that of one rig, and {self.reader.path} has {len(self.agents)}")
        found = {agent: self._cameras_of(agent, tree) for agent in self.agents}
        frames = {agent: [f for f in (s.left_frame, s.tof_frame) if f] for agent, s in found.items()}
        self.rigs = {"": self.agents} if self._names.rig.topics else rigs_of(frames, tree, self.reader.topics)
        for rig, cameras in self.rigs.items():
            placed, warnings = on_rig(rig, {name: found[name] for name in cameras}, self._counts(), self._names)
            self._warnings += warnings
            for name, own in placed.items():
                base = self._base_frame(rig, own.frames, own.left_frame or own.tof_frame)
                found[name] = replace(own, base_frame=base)
        return found

    def _counts(self) -> dict[str, int]:
        return {topic: info.count for topic, info in self.reader.topics.items()}

    def _cameras_of(self, agent: str, tree: FrameTree) -> AgentSensors:
        """The sensors in a namespace; which frame is that of their rig is not known yet."""
        given = self._names.rig.topics.get(agent, self._names.topics)
        topics = topics_of(agent, self.reader.topics, given)
        measurement = "range" if "range" in topics else "depth"
        if "range" in topics:
            topics["depth"] = topics.pop("range")
        if "color" in topics and not {"amplitude", "intensity"} & topics.keys():
            topics["amplitude"] = topics["color"]
        left, left_frame = self._camera_info(topics, "left", "left_info")
        right, _ = self._camera_info(topics, "right", "right_info")
        tof, tof_frame = self._camera_info(topics, "depth", "tof_info")
        for transform in self._names.calibration.transforms(left_frame, tof_frame):
            tree.add(transform.parent, transform.child, transform.T)
        return AgentSensors(agent, left, right, tof, measurement, tree, left_frame, tof_frame, topics=topics)

    def _base_frame(self, agent: str, tree: FrameTree, camera_frame: str) -> str:
        """Frame of the rig: base_link, or the root above the camera in a bag that has none."""
        usual = [frame for frame in (join(agent, "base_link")[1:], "base_link") if frame in tree]
        if self._names.base_frame or usual:
            return self._names.base_frame or usual[0]
        if camera_frame not in tree:
            own = f", or map in the camera's own axes (x right, y down, z forward): --base-frame {camera_frame}"
            others = f", and those of all agents ({', '.join(self.agents)})"
            raise ValueError(
                f"{self.reader.path} has no transform between base_link and '{camera_frame}' on /tf_static: record "
                f"it{own if len(self.agents) == 1 else others}"
            )
        root = tree.root(camera_frame)
        self._warnings.append(f"no base_link on /tf_static: poses are those of {root}, another frame: --base-frame")
        return root

    def _camera_info(self, topics: Mapping[str, str], role: str, info_role: str) -> tuple[CameraInfo | None, str]:
        """Calibration of the images as they are in the bag, and their frame."""
        if role not in topics:
            return None, ""
        topic = topics[info_role]
        if (given := self._names.calibration.info("tof" if role == "depth" else role)) is not None:
            if role != "depth" and is_rectified(topics[role]):
                raise ValueError(f"the images on {topics[role]} are rectified: a calibration is for raw images")
            return given, self._frame_of((topic, topics[role]))
        for _, _, message in self.reader.messages([topic]):
            return _as_recorded(camera_info_from_message(message), role, topics[role]), message.header.frame_id
        if self.reader.is_indexed and not self.reader.topics[topics[role]].count:
            raise ValueError(
                f"{self.reader.path} has no message on {topics[role]}: was the driver running? The messages that there "
                f"are: {', '.join(f'{name} {info.count}' for name, info in self.reader.topics.items())}"
            )
        raise ValueError(
            f"{self.reader.path} has images but no camera info on {topic}: record it (slam calibrate makes one), or "
            f"say where it is: --topic {info_role}=/..."
        )

    def _frame_of(self, topics: Sequence[str]) -> str:
        """Frame of the first message on the first of the topics that has one."""
        present = [topic for topic in topics if topic in self.reader.topics]
        messages = (m for topic in present for _, _, m in self.reader.messages([topic]))
        return next((str(m.header.frame_id) for m in messages), "")

    def _read_frames(self) -> FrameTree:
        tree = FrameTree()
        topics = [t for t in self.reader.topics if t.endswith("/tf_static")]
        for _, _, message in self.reader.messages(topics):
            for transform in message.transforms:
                tree.add(*transform_from_message(transform))
        for given in self._names.rig.transforms:
            tree.add(given.parent, given.child, given.T)
        return tree


def _as_recorded(info: CameraInfo, role: str, image_topic: str) -> CameraInfo:
    """Calibration of a camera's images as they are in the bag."""
    return CameraInfo(info.rectified, P=info.P) if role != "depth" and is_rectified(image_topic) else info


def _file_of(role: str) -> str:
    """Camera of a camera info's role as a calibration's files name it."""
    return role.removesuffix("_info")


def _with_ranks(readings: Iterator[R]) -> Generator[R, None, None]:
    for _, together in groupby(readings, key=lambda reading: reading.stamp_ns):
        yield from sorted(together, key=lambda reading: _RANKS.index(type(reading)))
