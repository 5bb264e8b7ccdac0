# SPDX-License-Identifier: Apache-2.0
"""Poses, motions and IMU readings. Covariances need no conversion: see the tangent order of ``slam_core.geometry``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from slam_core.geometry import FloatArray, pose7_from_transform, transform_from_pose7
from slam_core.messages.base import Message, MessageTypes, header_message, stamp_ns
from slam_core.types import ImuSample, OdometryReading, PoseEstimate, PositionReading, PressureReading, RelativeMotion

FARTHEST_M = 1e6
"""Positions beyond are no positions in a building; their squares would spoil covariances."""

LARGEST_VARIANCE = 1e12
FASTEST_RAD_S, STRONGEST_M_S2 = 1e3, 1e5
"""Beyond what an IMU can measure."""

STATIC_TRANSFORMS_TOPIC = "/static_transforms"
"""TransformStamped, latched, one message per transform: /tf_static for whoever has no tf2_msgs."""

_UNKNOWN_VARIANCE = 1e6  # of a velocity, m2/s2 and rad2/s2


def pose_message(types: MessageTypes, T: FloatArray) -> Message:
    """geometry_msgs/Pose of a transform (4, 4)."""
    x, y, z, qx, qy, qz, qw = (float(v) for v in pose7_from_transform(T))
    return types.Pose(position=types.Point(x=x, y=y, z=z), orientation=types.Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_from_message(pose: Message) -> FloatArray:
    """Transform (4, 4) of a geometry_msgs/Pose; ValueError if not finite or with a quaternion not of unit norm."""
    return _transform(pose.position, pose.orientation)


def pose_stamped_message(types: MessageTypes, stamp: int, frame_id: str, T: FloatArray) -> Message:
    """geometry_msgs/PoseStamped of T_frame_child (4, 4)."""
    return types.PoseStamped(header=header_message(types, stamp, frame_id), pose=pose_message(types, T))


def pose_with_covariance_message(types: MessageTypes, frame_id: str, estimate: PoseEstimate) -> Message:
    """geometry_msgs/PoseWithCovarianceStamped."""
    return types.PoseWithCovarianceStamped(
        header=header_message(types, estimate.stamp_ns, frame_id), pose=_with_covariance(types, estimate)
    )


def position_message(types: MessageTypes, frame_id: str, reading: PositionReading) -> Message:
    """geometry_msgs/PoseWithCovarianceStamped of a position alone: its rotation is unknown."""
    T, covariance = np.eye(4), _UNKNOWN_VARIANCE * np.eye(6)
    T[:3, 3], covariance[:3, :3] = reading.position, reading.covariance
    return pose_with_covariance_message(types, frame_id, PoseEstimate(reading.stamp_ns, T, covariance))


def position_from_message(message: Message) -> PositionReading:
    """Position of a geometry_msgs/PoseWithCovarianceStamped, whatever its orientation.

    Raises
    ------
    ValueError
        If the position is not finite.
    """
    position = _xyz(message.pose.pose.position)
    if not np.isfinite(position).all():
        raise ValueError(f"position is not finite: {position.tolist()}")
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return PositionReading(stamp_ns(message), position, covariance[:3, :3])


def odometry_message(
    types: MessageTypes,
    frame_id: str,
    child_frame_id: str,
    estimate: PoseEstimate,
    twist: tuple[FloatArray, FloatArray] | None = None,
) -> Message:
    """nav_msgs/Odometry of T_frame_child.

    ``twist``: linear m/s and angular rad/s (6,) in the child frame, and its covariance (6, 6); where there is none,
    zero with variances of 1e6, since readers such as robot_localization take whatever variance they find.
    """
    return types.Odometry(
        header=header_message(types, estimate.stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=_with_covariance(types, estimate),
        twist=_twist(types, twist),
    )


def _twist(types: MessageTypes, twist: tuple[FloatArray, FloatArray] | None) -> Message:
    velocity, covariance = (np.zeros(6), _UNKNOWN_VARIANCE * np.eye(6)) if twist is None else twist
    parts = types.Twist(linear=_vector(types, velocity[:3]), angular=_vector(types, velocity[3:]))
    return types.TwistWithCovariance(twist=parts, covariance=np.asarray(covariance, dtype=np.float64).ravel())


def odometry_from_message(message: Message) -> OdometryReading:
    """Pose and covariances of a nav_msgs/Odometry, the latter as they are.

    Raises
    ------
    ValueError
        If the pose is not finite or no pose, or no child frame is named.
    """
    if not message.child_frame_id:
        raise ValueError("odometry without a child_frame_id: what moves there is not known")
    pose, twist = message.pose, message.twist
    velocity = np.concatenate([_xyz(twist.twist.linear), _xyz(twist.twist.angular)])
    covariances = (np.array(part.covariance, dtype=np.float64).reshape(6, 6) for part in (pose, twist))
    return OdometryReading(
        stamp_ns(message), pose_from_message(pose.pose), next(covariances), velocity, next(covariances),
        message.child_frame_id,
    )  # fmt: skip


def estimate_from_message(message: Message) -> PoseEstimate:
    """Pose with covariance of an Odometry or a PoseWithCovarianceStamped."""
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    if not np.abs(covariance).max() <= LARGEST_VARIANCE:
        raise ValueError(f"pose covariance is not finite, or beyond {LARGEST_VARIANCE:g}")
    return PoseEstimate(stamp_ns(message), pose_from_message(message.pose.pose), covariance)


def motion_message(types: MessageTypes, frame_id: str, stamp: int, motion: RelativeMotion | None) -> Message:
    """PoseWithCovarianceStamped of the motion that ended at ``stamp``, in the frame as it was at its start.

    That frame is named ``<frame>@<start ns>``. A motion that is not known starts at its own end: a reader who pairs by
    stamp then need not wait for what will never come.
    """
    motion = motion or RelativeMotion(stamp, stamp, np.eye(4), np.zeros((6, 6)))
    end = PoseEstimate(motion.end_stamp_ns, motion.T, motion.covariance)
    return pose_with_covariance_message(types, f"{frame_id}@{motion.start_stamp_ns}", end)


def motion_from_message(message: Message) -> RelativeMotion | None:
    """Inverse of :func:`motion_message`; None for a motion that is not known."""
    _, separator, start = message.header.frame_id.rpartition("@")
    if not separator or not start.isdigit():
        raise ValueError(f"a motion's frame is '<frame>@<start ns>', got '{message.header.frame_id}'")
    end = estimate_from_message(message)
    motion = RelativeMotion(int(start), end.stamp_ns, end.T, end.covariance)
    return motion if motion.start_stamp_ns != motion.end_stamp_ns else None


def motion_as_received(motion: RelativeMotion | None) -> RelativeMotion | None:
    """A motion after its way through :func:`motion_message`, whose quaternion rounds the rotation by 1e-16."""
    if motion is None:
        return None
    return replace(motion, T=transform_from_pose7(pose7_from_transform(motion.T)))


def path_message(types: MessageTypes, stamp: int, frame_id: str, poses: Iterable[PoseEstimate]) -> Message:
    """nav_msgs/Path of poses T_frame_rig; each keeps its own stamp."""
    stamped = [pose_stamped_message(types, p.stamp_ns, frame_id, p.T) for p in poses]
    return types.Path(header=header_message(types, stamp, frame_id), poses=stamped)


def path_from_message(message: Message) -> list[tuple[int, FloatArray]]:
    """Stamps (ns) and transforms (4, 4) of a nav_msgs/Path."""
    return [(stamp_ns(pose), pose_from_message(pose.pose)) for pose in message.poses]


def transform_message(types: MessageTypes, stamp: int, parent: str, child: str, T_parent_child: FloatArray) -> Message:
    """geometry_msgs/TransformStamped."""
    return pose7_message(types, stamp, parent, child, pose7_from_transform(T_parent_child))


def pose7_message(types: MessageTypes, stamp: int, parent: str, child: str, pose: FloatArray) -> Message:
    """geometry_msgs/TransformStamped of ``x y z qx qy qz qw``, the same numbers."""
    x, y, z, qx, qy, qz, qw = (float(v) for v in pose)
    transform = types.Transform(
        translation=types.Vector3(x=x, y=y, z=z), rotation=types.Quaternion(x=qx, y=qy, z=qz, w=qw)
    )
    return types.TransformStamped(
        header=header_message(types, stamp, parent), child_frame_id=child, transform=transform
    )


def transform_from_message(message: Message) -> tuple[str, str, FloatArray]:
    """Parent, child and T_parent_child (4, 4) of a geometry_msgs/TransformStamped."""
    parent, child, pose = pose7_from_message(message)
    return parent, child, transform_from_pose7(pose)


def pose7_from_message(message: Message) -> tuple[str, str, FloatArray]:
    """Parent, child and ``x y z qx qy qz qw`` of a geometry_msgs/TransformStamped, as they are written there."""
    transform = message.transform
    return message.header.frame_id, message.child_frame_id, _pose7(transform.translation, transform.rotation)


def imu_message(types: MessageTypes, frame_id: str, sample: ImuSample) -> Message:
    """sensor_msgs/Imu without orientation (its covariance starts with -1, as REP-145 asks)."""
    unknown = np.zeros(9)
    unknown[0] = -1.0
    return types.Imu(
        header=header_message(types, sample.stamp_ns, frame_id),
        orientation=types.Quaternion(w=1.0),
        orientation_covariance=unknown,
        angular_velocity=_vector(types, sample.angular_velocity),
        linear_acceleration=_vector(types, sample.linear_acceleration),
    )


def imu_from_message(message: Message) -> ImuSample:
    """Angular velocity and acceleration of a sensor_msgs/Imu, in the axes of its frame."""
    rate, acceleration = _xyz(message.angular_velocity), _xyz(message.linear_acceleration)
    if not (np.isfinite(rate).all() and np.isfinite(acceleration).all()):
        raise ValueError(f"IMU reading is not finite: {rate} rad/s, {acceleration} m/s2")
    if np.abs(rate).max() > FASTEST_RAD_S or np.abs(acceleration).max() > STRONGEST_M_S2:
        raise ValueError(f"IMU reading is beyond what can be: {rate} rad/s, {acceleration} m/s2")
    if message.angular_velocity_covariance[0] == -1.0 or message.linear_acceleration_covariance[0] == -1.0:
        raise ValueError("IMU message has no angular velocity or no acceleration (covariance -1)")
    return ImuSample(stamp_ns(message), rate, acceleration, message.header.frame_id)


def pressure_message(types: MessageTypes, frame_id: str, reading: PressureReading) -> Message:
    """sensor_msgs/FluidPressure of the air."""
    header = header_message(types, reading.stamp_ns, frame_id)
    return types.FluidPressure(header=header, fluid_pressure=reading.pressure, variance=reading.variance)


def pressure_from_message(message: Message) -> PressureReading:
    """Pressure (Pa) of a sensor_msgs/FluidPressure, with its variance as it is.

    Raises
    ------
    ValueError
        If the pressure is not finite.
    """
    pressure = float(message.fluid_pressure)
    if not np.isfinite(pressure):
        raise ValueError(f"pressure is not finite: {pressure} Pa")
    return PressureReading(stamp_ns(message), pressure, float(message.variance))


def _with_covariance(types: MessageTypes, estimate: PoseEstimate) -> Message:
    covariance = np.asarray(estimate.covariance, dtype=np.float64).ravel()
    return types.PoseWithCovariance(pose=pose_message(types, estimate.T), covariance=covariance)


def _transform(position: Message, orientation: Message) -> FloatArray:
    return transform_from_pose7(_pose7(position, orientation))


def _pose7(position: Message, orientation: Message) -> FloatArray:
    q = orientation
    pose = np.array([*_xyz(position), q.x, q.y, q.z, q.w], dtype=np.float64)
    if not np.isfinite(pose).all():
        raise ValueError(f"pose is not finite: {pose.tolist()}")
    if np.abs(pose[:3]).max() > FARTHEST_M:
        raise ValueError(f"position is beyond {FARTHEST_M:g} m: {pose[:3].tolist()}")
    return pose


def _vector(types: MessageTypes, xyz: FloatArray) -> Message:
    return types.Vector3(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def _xyz(vector: Message) -> FloatArray:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)
