# SPDX-License-Identifier: Apache-2.0
"""Several cameras on a simulated rig: each sees what it would alone at its place, and a blank wall shows nothing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slam_simulation import Scenario, Simulator
from slam_simulation.scenario import CameraMount

SMALL = {"width": 160, "height": 120, "focal_length": 70.0, "raw_focal_length": 80.0}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    plan = Scenario.load("back_to_back")
    return replace(plan, suite=replace(plan.suite, stereo=replace(plan.suite.stereo, **SMALL)))


def quiet(scenario: Scenario) -> Scenario:
    stereo = replace(scenario.suite.stereo, read_noise=0.0, electrons_per_level=1e9, exposure_ms=0.0, gain_jitter=0.0)
    return replace(scenario, suite=replace(scenario.suite, stereo=stereo))


def test_the_front_camera_is_where_a_single_one_would_be_and_the_back_one_looks_back(scenario: Scenario) -> None:
    alone = Simulator(replace(scenario, cameras=()), threads=1)
    front, back = (Simulator(scenario, camera=k, threads=1) for k in range(2))
    np.testing.assert_allclose(front.T_rig_left[:3, :3], alone.T_rig_left[:3, :3], atol=1e-12)
    np.testing.assert_allclose(front.T_rig_left[:3, 3] - alone.T_rig_left[:3, 3], [0.05, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(back.T_rig_left[:3, 2], [-1.0, 0.0, 0.0], atol=1e-2)
    assert len(next(front.run(1)).imu) == len(next(alone.run(1)).imu) > 0
    assert next(back.run(1)).imu == ()


def test_a_camera_turned_round_sees_what_the_turned_rig_sees(scenario: Scenario) -> None:
    turned = replace(quiet(scenario), cameras=(CameraMount("a", yaw=90.0),))
    ahead = replace(turned, cameras=(CameraMount("a"),))
    one, other = Simulator(turned, threads=1), Simulator(ahead, threads=1)
    R = CameraMount("a", yaw=90.0).T_rig_mount

    class TurnedPath:
        duration = other.path.duration

        def pose(self, t: float) -> np.ndarray:
            return one.path.pose(t) @ R

    other.path = other._seen = TurnedPath()
    a, b = next(one.run(1)).left, next(other.run(1)).left
    assert a is not None
    assert b is not None
    assert np.abs(a.astype(int) - b.astype(int)).max() <= 1


def test_a_blank_wall_shows_nothing_to_the_front_camera_alone(scenario: Scenario) -> None:
    plan = quiet(scenario)
    pictures = [next(Simulator(plan, camera=k, threads=1).run(31, first=30)).left for k in range(2)]
    edges = [np.abs(cv2.Laplacian(p[30:70, 50:110], cv2.CV_64F)).mean() for p in pictures if p is not None]
    assert edges[0] < 0.2 * edges[1]


def test_two_cameras_of_one_name_are_refused(scenario: Scenario) -> None:
    with pytest.raises(ValueError, match="one name"):
        replace(scenario, cameras=(CameraMount("a"), CameraMount("a")))
    with pytest.raises(ValueError, match="needs a name"):
        CameraMount("a b")
