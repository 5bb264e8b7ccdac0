# SPDX-License-Identifier: Apache-2.0
"""Nodes as other packages hear them: odometry by robot_localization's rules, /tf and /tf_static over another DDS.

What robot_localization asks of nav_msgs/Odometry stands in its doc/preparing_sensor_data.rst and in
``RosFilter::odometryCallback`` and ``Ekf::correct`` (branch ros2): the pose in ``frame_id``, the twist in
``child_frame_id``; no variance below 1e-9, which it replaces (that of the first pose, the origin, is); stamps that go
on, quaternions of unit norm.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("cyclonedds", reason="cyclonedds is not installed (requirements-dev.txt)")
pytestmark = pytest.mark.ros

from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import LaserScan  # noqa: E402

from feature_chain import START, STEP_NS, Chain, loop, stamp_of  # noqa: E402
from ros_probe import Probe  # noqa: E402
from slam_core.geometry import so3_left_jacobian, so3_log  # noqa: E402
from slam_core.messages import header_message, pose_from_message  # noqa: E402
from tf_over_dds import TransformStamped, mounting, reader, writer  # noqa: E402

LEAST_VARIANCE = 1e-9
UNKNOWN_VARIANCE = 1e6


def check_odometry(messages: list[Any], known_twist: int) -> None:
    """By the rules above; all but ``known_twist`` messages may say that they do not know the velocity."""
    stamps = [stamp_of(message) for message in messages]
    assert stamps == sorted(set(stamps))
    known = 0
    for message in messages:
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        q = message.pose.pose.orientation
        assert np.linalg.norm([q.x, q.y, q.z, q.w]) == pytest.approx(1.0, abs=1e-6)
        for covariance in (message.pose.covariance, message.twist.covariance):
            P = np.reshape(covariance, (6, 6))
            np.testing.assert_allclose(P, P.T, rtol=1e-9, atol=1e-15)
            assert np.linalg.eigvalsh(P).min() > 0.0
        assert np.diag(np.reshape(message.twist.covariance, (6, 6))).min() >= LEAST_VARIANCE
        known += message.twist.covariance[0] < UNKNOWN_VARIANCE
    assert known >= known_twist


def check_twist(messages: list[Any]) -> None:
    """The velocity, integrated along the axes of ``child_frame_id``, is the way from pose to pose."""
    for before, after in itertools.pairwise(messages):
        seconds = (stamp_of(after) - stamp_of(before)) * 1e-9
        T = np.linalg.solve(*(pose_from_message(m.pose.pose) for m in (before, after)))
        twist = after.twist.twist
        linear, angular = (np.array([v.x, v.y, v.z]) for v in (twist.linear, twist.angular))
        np.testing.assert_allclose(so3_left_jacobian(angular * seconds) @ linear * seconds, T[:3, 3], atol=0.02)
        np.testing.assert_allclose(angular * seconds, so3_log(T[:3, :3]), atol=0.02)


def test_filters_odometry_is_as_robot_localization_wants_it_and_tf_says_the_same(tmp_path: Path, domain: int) -> None:
    tf = reader(domain)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, tmp_path)
    try:
        chain.connect()
        chain.send_frames(loop(80)[:20], START)
        chain.wait_for_odometry(START + 19 * STEP_NS)
        odometry = chain.received["odom"]
        heard: list[TransformStamped] = []

        def tf_has_come() -> bool:
            heard.extend(t for sample in tf.take(1000) for t in getattr(sample, "transforms", ()))
            return {("map", "odom"), ("odom", "base_link")} <= {(t.header.frame_id, t.child_frame_id) for t in heard}

        chain.wait(tf_has_come, "no transforms from odom and map")
    finally:
        codes = chain.end()
        rclpy.shutdown(context=context)
    assert codes == [0, 0]
    check_odometry(odometry, known_twist=19)
    check_twist(odometry[3:])
    poses = {stamp_of(m): m.pose.pose for m in odometry}
    to_base = [t for t in heard if t.child_frame_id == "base_link"]
    assert len(to_base) >= 10
    for transform in to_base:
        pose, t = poses[stamp_of(transform)], transform.transform
        assert (t.translation.x, t.translation.y, t.translation.z) == (
            pose.position.x,
            pose.position.y,
            pose.position.z,
        )
        assert (t.rotation.x, t.rotation.w) == (pose.orientation.x, pose.orientation.w)


@pytest.fixture
def laser(domain: int) -> Iterator[Probe]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = Probe(context)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command = [sys.executable, "-c", "from ndt_registration.node import main; main()",
               "--ros-args", "-p", "input.policy:=all"]  # fmt: skip
    process = subprocess.Popen(command, env=environment)
    yield probe
    process.kill()
    process.wait()
    probe.executor.shutdown(timeout_sec=2.0)
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


def room_scan(x: float) -> list[float]:
    """Ranges to the walls of a room of 6 x 4 m from x m off its middle."""
    angle = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.where(c > 0, (3.0 - x) / c, (-3.0 - x) / c), np.where(s > 0, 2.2 / s, -1.8 / s))
    return [float(r) for r in ranges]


def test_scan_odometry_is_so_too_and_knows_frames_from_tf_static(laser: Probe, domain: int) -> None:
    static = writer(domain)
    static.write(mounting("base_link", "laser", 0.2))
    laser.listen("ndt/odometry", Odometry)
    rng = np.random.default_rng(3)
    for k in range(8):
        header = header_message(laser.types, START + k * STEP_NS, "laser")
        ranges = [r + 0.003 * float(rng.standard_normal()) for r in room_scan(0.05 * k)]
        laser.send("scan", LaserScan(header=header, angle_min=-np.pi, angle_increment=2 * np.pi / 360, range_min=0.1,
                                     range_max=30.0, ranges=ranges))  # fmt: skip
    odometry = laser.received["ndt/odometry"]
    laser.wait(lambda: len(odometry) >= 7, "no odometry of the scans")
    check_odometry(odometry, known_twist=5)
    check_twist(odometry)
    assert odometry[-1].twist.twist.linear.x == pytest.approx(0.5, abs=0.15)
