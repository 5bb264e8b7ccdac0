# SPDX-License-Identifier: Apache-2.0
"""Messages of one agent as readings of its sensors, paired by stamp and decoded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from ndt_registration.stage import Scan
from slam_bags.reading.left_out import LeftOut
from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray
from slam_core.messages import (
    colour_from_message,
    grey_and_colour_from_message,
    grey_from_message,
    imu_from_message,
    mask_from_message,
    odometry_from_message,
    picture_from_message,
    points_from_scan,
    position_from_message,
    pressure_from_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S, StampSynchronizer
from slam_core.types import ByteArray, ImuSample, Mask, OdometryReading, PositionReading, PressureReading
from stereo_frontend.sources import RawPair
from tof_driver.stage import RawDepth


@dataclass(frozen=True, eq=False)
class StereoReading:
    """A pair as recorded."""

    agent: str
    pair: RawPair

    @property
    def stamp_ns(self) -> int:
        """Stamp of the left image."""
        return self.pair.stamp_ns


@dataclass(frozen=True, eq=False)
class DepthReading:
    """Images of a ToF or depth camera as recorded."""

    agent: str
    raw: RawDepth

    @property
    def stamp_ns(self) -> int:
        """Stamp of the range or depth image."""
        return self.raw.stamp_ns


@dataclass(frozen=True, eq=False)
class ImuReading:
    """An IMU sample in the axes of the IMU."""

    agent: str
    sample: ImuSample

    @property
    def stamp_ns(self) -> int:
        """Stamp of the sample."""
        return self.sample.stamp_ns


@dataclass(frozen=True, eq=False)
class PoseReading:
    """A pose of an external odometry, of a frame of its own."""

    agent: str
    pose: OdometryReading

    @property
    def stamp_ns(self) -> int:
        """Stamp of the pose."""
        return self.pose.stamp_ns


@dataclass(frozen=True, eq=False)
class FixReading:
    """A position of an agent's antenna in a fixed frame."""

    agent: str
    position: PositionReading

    @property
    def stamp_ns(self) -> int:
        """Stamp of the position."""
        return self.position.stamp_ns


@dataclass(frozen=True, eq=False)
class AirReading:
    """A pressure of the air around an agent."""

    agent: str
    pressure: PressureReading

    @property
    def stamp_ns(self) -> int:
        """Stamp of the pressure."""
        return self.pressure.stamp_ns


@dataclass(frozen=True, eq=False)
class LaserReading:
    """A scan of a laser scanner, points (n, 2) in its own frame."""

    agent: str
    scan: Scan

    @property
    def stamp_ns(self) -> int:
        """Stamp of the scan."""
        return self.scan.stamp_ns


@dataclass(frozen=True, eq=False)
class ColourReading:
    """A colour picture (h, w, 3) uint8, red first, in the pixels of the raw depth image."""

    agent: str
    stamp_ns: int
    image: ByteArray


@dataclass(frozen=True, eq=False)
class MaskReading:
    """A mask of the rectified images of ``camera``: "stereo", of its left one, or "tof"."""

    agent: str
    camera: str
    mask: Mask

    @property
    def stamp_ns(self) -> int:
        """Stamp of the image that it belongs to."""
        return self.mask.stamp_ns


@dataclass(frozen=True)
class SessionStart:
    """The clock of an agent's sensors has jumped back for good: what follows has nothing to do with what was before."""

    agent: str
    stamp_ns: int


@dataclass(frozen=True, eq=False)
class InfoReading:
    """A camera info that is the first of its camera ("left", "right", "depth") or differs from the one before."""

    agent: str
    stamp_ns: int
    camera: str
    info: CameraInfo


Reading = (
    StereoReading
    | DepthReading
    | LaserReading
    | ImuReading
    | PoseReading
    | FixReading
    | AirReading
    | ColourReading
    | MaskReading
    | SessionStart
)


@dataclass(frozen=True, eq=False)
class AgentSensors:
    """Sensors of one agent. Frames and infos are None where there is no such sensor.

    Of a rig with several cameras these are the sensors of one of them, ``agent`` is its namespace, ``rig`` that of the
    rig and ``camera`` its name there; those that are no cameras are the first camera's. ``measurement``: "range" along
    the ray or "depth" along z. ``frames``: the static transforms between its frames.
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
    """Role ("left", "depth", "tof_info", "imu", ...) to the bag's topic; "depth" holds what ``measurement`` says."""
    rig: str = ""
    camera: str = ""

    def transform(self, target: str, source: str) -> FloatArray:
        """T_target_source between "base", "left" and "tof"; ValueError if the bag does not know it."""
        names = {"base": self.base_frame, "left": self.left_frame, "tof": self.tof_frame}
        return self.frames.lookup(names[target], names[source])

    @property
    def scanner(self) -> str:
        """Role whose scans are registered: "depth", "scan" of a rig without a depth camera, "" of one with neither."""
        return next((role for role in ("depth", "scan") if role in self.topics), "")

    def is_mounted(self, camera: str) -> bool:
        """True if the bag has "left" or "tof" and knows where it sits on the rig."""
        try:
            self.transform("base", camera)
        except ValueError:
            return False
        return (self.tof if camera == "tof" else self.left) is not None


def _imu_reading(sensors: AgentSensors, message: Message) -> Reading:
    sample = imu_from_message(message)
    sensors.frames.lookup(sensors.base_frame, sample.frame_id)  # unusable where that is not known
    return ImuReading(sensors.agent, sample)


def _pose_reading(sensors: AgentSensors, message: Message) -> Reading:
    pose = odometry_from_message(message)
    sensors.frames.lookup(sensors.base_frame, pose.frame_id)  # unusable where that is not known
    return PoseReading(sensors.agent, pose)


def _fix_reading(sensors: AgentSensors, message: Message) -> Reading:
    return FixReading(sensors.agent, position_from_message(message))


def _air_reading(sensors: AgentSensors, message: Message) -> Reading:
    return AirReading(sensors.agent, pressure_from_message(message))


def _laser_reading(sensors: AgentSensors, message: Message) -> Reading:
    return LaserReading(sensors.agent, Scan(stamp_ns(message), points_from_scan(message), message.header.frame_id))


def _colour_reading(sensors: AgentSensors, message: Message) -> Reading:
    return ColourReading(sensors.agent, stamp_ns(message), colour_from_message(message))


def _mask_reading(camera: str, sensors: AgentSensors, message: Message) -> Reading:
    return MaskReading(sensors.agent, camera, mask_from_message(message))


MASK_ROLES = {"stereo": "mask", "tof": "tof_mask"}
"""Role of the masks of each camera."""

UNPAIRED_ROLES: dict[str, Callable[[AgentSensors, Message], Reading]] = {
    "imu": _imu_reading,
    "odometry": _pose_reading,
    "position": _fix_reading,
    "pressure": _air_reading,
    "scan": _laser_reading,
    "color": _colour_reading,
    "mask": partial(_mask_reading, "stereo"),
    "tof_mask": partial(_mask_reading, "tof"),
}
"""Decoders of the roles whose every message is a reading by itself."""

IMAGE_ROLES = ("left", "right", "depth", "amplitude", "intensity")
"""Roles whose messages are paired by stamp to readings of cameras."""

ROLES_READ = (*IMAGE_ROLES, *UNPAIRED_ROLES)
"""Roles whose messages become readings."""


INFO_ROLES = {"left_info": "left", "right_info": "right", "tof_info": "depth"}
"""Camera of each role of a camera info."""


class AgentPairing:
    """Pairs one agent's messages by stamp, whatever these are; messages of no use are counted in ``left_out``."""

    def __init__(self, sensors: AgentSensors, left_out: LeftOut) -> None:
        self._sensors = sensors
        self._left_out = left_out
        self._ready: list[Reading] = []
        has_stereo = {"left", "right"} <= sensors.topics.keys()
        depth_roles = [role for role in ("depth", "amplitude", "intensity") if role in sensors.topics]
        stereo_roles = ("left", "right") if has_stereo else ()
        tolerance_ns = round(PAIRING_TOLERANCE_S * 1e9)
        self._stereo = StampSynchronizer[Message](stereo_roles, self._on_stereo, tolerance_ns=tolerance_ns)
        self._depth = StampSynchronizer[Message](depth_roles, self._on_depth, tolerance_ns=tolerance_ns)
        self._depth_roles = depth_roles

    def add(self, role: str, message: Message) -> list[Reading]:
        """The readings that this message completes."""
        self._ready = []
        try:
            if role in UNPAIRED_ROLES:
                self._ready.append(UNPAIRED_ROLES[role](self._sensors, message))
            elif role in ("left", "right"):
                self._stereo.add(role, stamp_ns(message), message)
            else:
                self._depth.add(role, stamp_ns(message), message)
        except ValueError as error:
            self._left_out.unusable(self._sensors.topics[role], error)
        return self._ready

    @property
    def unpaired(self) -> int:
        """Images that were dropped because their partners never came."""
        return self._stereo.unpaired + self._depth.unpaired

    def flush(self) -> None:
        """Let no image wait any more; those that do are unpaired."""
        self._stereo.clear()
        self._depth.clear()

    def _on_stereo(self, stamp: int, messages: tuple[Message, ...]) -> None:
        left, colour = grey_and_colour_from_message(messages[0])
        pair = RawPair(stamp, left, grey_from_message(messages[1]), self._sensors.left_frame, colour)
        self._ready.append(StereoReading(self._sensors.agent, pair))

    def _on_depth(self, stamp: int, messages: tuple[Message, ...]) -> None:
        images = dict(zip(self._depth_roles, (picture_from_message(m) for m in messages), strict=True))
        raw = RawDepth(
            stamp, images["depth"], images.get("amplitude"), images.get("intensity"), self._sensors.tof_frame
        )
        self._ready.append(DepthReading(self._sensors.agent, raw))
