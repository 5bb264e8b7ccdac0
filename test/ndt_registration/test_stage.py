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
from slam_core.geometry import boxplus
from slam_core.types import ImuSample

T_BASE_TOF = boxplus(np.eye(4), np.array([0.1, 0.0, 0.3, 0.0, 0.1, 0.2]))


def stage(*, gyro: bool = False) -> ScanOdometryStage:
    tree = FrameTree()
    tree.add("base_link", "tof_optical_frame", T_BASE_TOF)
    tree.add("base_link", "imu_link", np.eye(4))
    return ScanOdometryStage(replace(OdometryConfig(), imu=GyroConfig(enabled=gyro)), tree)


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


def test_an_imu_that_is_not_used_holds_nothing_up(corner) -> None:
    scans = stage()
    scans.add_imu(ImuSample(0, np.zeros(3), np.zeros(3), "imu_link"))
    scans.add_scan(Scan(10, corner))
    assert len(list(scans.ready())) == 1
