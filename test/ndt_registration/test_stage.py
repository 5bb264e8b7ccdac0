# SPDX-License-Identifier: Apache-2.0
"""Scan odometry's stage: the motion of the rig, and a scan waits for the IMU that is to predict its turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ndt_registration.gyro import GyroConfig
from ndt_registration.odometry import OdometryConfig
from ndt_registration.stage import Scan, ScanOdometryStage
from slam_core.frame_tree import FrameTree
from slam_core.geometry import boxplus, so3_log
from slam_core.types import ImuSample

T_BASE_TOF = boxplus(np.eye(4), np.array([0.1, 0.0, 0.3, 0.0, 0.1, 0.2]))


def stage(*, gyro: bool = False, late_s: float = 0.0) -> ScanOdometryStage:
    tree = FrameTree()
    tree.add("base_link", "tof_optical_frame", T_BASE_TOF)
    tree.add("base_link", "imu_link", np.eye(4))
    return ScanOdometryStage(replace(OdometryConfig(), imu=GyroConfig(enabled=gyro, time_offset=late_s)), tree)


@pytest.fixture
def corner(rng) -> np.ndarray:
    """Three walls of a room, seen from inside."""
    uv = rng.uniform(-1.5, 1.5, (3, 1500, 2))
    far = np.full((1500, 1), 2.0)
    return np.concatenate(
        [np.hstack([uv[0], far]), np.hstack([far, uv[1]]), np.hstack([uv[2][:, :1], far, uv[2][:, 1:]])]
    )


def test_the_first_scan_is_the_rigs_origin(corner) -> None:
    scans = stage()
    scans.add_scan(Scan(1, corner))
    (estimate,) = scans.ready()
    np.testing.assert_allclose(estimate.pose.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(estimate.T_odom_sensor, T_BASE_TOF, atol=1e-12)
    assert estimate.motion is None
    assert scans.counters.counts == {"started": 1}


def test_a_scan_waits_for_the_imu_and_goes_without_it_when_told(corner) -> None:
    scans = stage(gyro=True)
    scans.add_imu(ImuSample(0, np.zeros(3), np.zeros(3), "imu_link"))
    scans.add_scan(Scan(10, corner))
    assert list(scans.ready()) == []
    scans.add_imu(ImuSample(10, np.zeros(3), np.zeros(3), "imu_link"))
    assert len(list(scans.ready())) == 1
    scans.add_scan(Scan(20, corner))
    assert list(scans.ready()) == []
    scans.give_up()
    assert len(list(scans.ready())) == 1
    assert "no imu" in scans.diagnostic


def test_the_imus_clock_is_that_of_the_scans(corner) -> None:
    """A turn that begins with the second scan, but 20 ms early by the stamps: without the offset it bends the guess."""
    step, rate = 5_000_000, np.array([0.0, 0.0, 40.0])
    turns = {}
    for late_s in (0.0, 0.02):
        scans = stage(gyro=True, late_s=late_s)
        scans.add_scan(Scan(100_000_000, corner))
        scans.add_scan(Scan(200_000_000, np.full_like(corner, np.nan)))
        for stamp in range(0, 260_000_000, step):
            felt = rate if stamp >= 180_000_000 else np.zeros(3)
            scans.add_imu(ImuSample(stamp, felt, np.zeros(3), "imu_link"))
        last = list(scans.ready())[-1]
        turns[late_s] = np.linalg.norm(so3_log(last.pose.T[:3, :3]))
    assert turns[0.02] < 1e-6
    assert turns[0.0] == pytest.approx(0.02 * 40.0, rel=0.3)


def test_an_imu_that_is_not_used_holds_nothing_up(corner) -> None:
    scans = stage()
    scans.add_imu(ImuSample(0, np.zeros(3), np.zeros(3), "imu_link"))
    scans.add_scan(Scan(10, corner))
    assert len(list(scans.ready())) == 1
