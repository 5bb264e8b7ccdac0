# SPDX-License-Identifier: Apache-2.0
"""The ``ndt_odometry`` process on the scans of a laser scanner."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import LaserScan  # noqa: E402

from ros_probe import Probe  # noqa: E402
from slam_core.messages import header_message, motion_from_message, points_message  # noqa: E402

pytestmark = pytest.mark.ros

START = "from ndt_registration.node import main; main()"
RAYS = 360
STEP = 0.1


@pytest.fixture
def probe(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Probe]:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = Probe(context)
    arguments = ["--ros-args", "-p", "input.policy:=all", "-p", "base_frame:=laser"]
    process = subprocess.Popen([sys.executable, "-c", START, *arguments], stderr=subprocess.PIPE)
    yield probe
    process.kill()
    process.wait()
    probe.executor.shutdown(timeout_sec=2.0)
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


def corner_scan(x: float) -> np.ndarray:
    """Ranges to the walls of a room of 6 x 4 m with a pillar, from x m off its middle."""
    angle = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.where(c > 0, (3.0 - x) / c, (-3.0 - x) / c), np.where(s > 0, 2.2 / s, -1.8 / s))
    across, ahead = c * 1.0 - s * (1.5 - x), c * (1.5 - x) + s * 1.0
    return np.where((np.abs(across) < 0.3) & (ahead > 0), np.minimum(ranges, ahead), ranges)


def test_laser_scans_become_odometry_and_another_sensor_is_refused(probe: Probe) -> None:
    probe.listen("ndt/odometry", Odometry)
    probe.listen("ndt/motion", PoseWithCovarianceStamped)
    rng = np.random.default_rng(3)
    for k in range(4):
        stamp = 10**9 + k * 10**8
        header = header_message(probe.types, stamp, "laser")
        ranges = corner_scan(STEP * k) + 0.003 * rng.standard_normal(RAYS)
        probe.send(
            "scan",
            LaserScan(header=header, angle_min=-np.pi, angle_increment=2 * np.pi / RAYS, range_min=0.1,
                      range_max=30.0, ranges=ranges.tolist()),
        )  # fmt: skip
        if k == 1:
            cloud = rng.uniform(-3.0, 3.0, (500, 3))
            probe.send(
                "tof/points", points_message(probe.types, header_message(probe.types, stamp + 1, "laser"), cloud)
            )
    odometry, messages = probe.received["ndt/odometry"], probe.received["ndt/motion"]
    probe.wait(lambda: min(len(odometry), len(messages)) >= 4, "no odometry of the scans")
    assert odometry[3].pose.pose.position.x == pytest.approx(3 * STEP, abs=0.02)
    assert odometry[3].pose.pose.position.z == pytest.approx(0.0, abs=1e-9)
    assert len(odometry) == len(messages) == 4
    motion = motion_from_message(messages[-1])
    assert motion is not None
    assert motion.T[0, 3] == pytest.approx(STEP, abs=0.02)
