# SPDX-License-Identifier: Apache-2.0
"""/tf and /tf_static for tests through another DDS, Cyclone, with types of its own.

Annotations are evaluated at once: cyclonedds reads the fields of a type from them.
"""

from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


_RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))


def reader(domain: int) -> DataReader:
    """Reader of /tf."""
    participant = DomainParticipant(domain)
    return DataReader(
        participant, Topic(participant, "rt/tf", TFMessage), qos=Qos(_RELIABLE, Policy.History.KeepLast(1000))
    )


def writer(domain: int) -> DataWriter:
    """Writer of /tf_static, latched."""
    participant = DomainParticipant(domain)
    quality = Qos(_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(10))
    return DataWriter(participant, Topic(participant, "rt/tf_static", TFMessage), qos=quality)


def mounting(parent: str, child: str, x: float) -> TFMessage:
    """A frame x m ahead of another one."""
    transform = Transform(Vector3(x=x), Quaternion())
    return TFMessage([TransformStamped(Header(Time(0, 0), parent), child, transform)])
