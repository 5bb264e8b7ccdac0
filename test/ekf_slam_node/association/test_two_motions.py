# SPDX-License-Identifier: Apache-2.0
"""Somebody walks ahead of the rig: his features are found and left out; without another sensor that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imu_world import carried, readings

from ekf_slam_node.association.two_motions import MovingTracks
from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from feature_world import PointWorld, room
from slam_core.geometry import FloatArray, boxminus
from slam_core.types import Features, FeatureSource

_RATE, _FRAMES = 10, 60
_STEP_NS = 1_000_000_000 // _RATE
_BODY = 0.3
"""Half extent of somebody, m."""


class Companion:
    """Points on somebody who keeps 1.3 m ahead of the rig from frame 20 on, swaying; before that he stands aside."""

    def __init__(self, number: int, rng: np.random.Generator) -> None:
        self._own = rng.uniform(-_BODY, _BODY, (number, 3))
        looks = rng.standard_normal((number, 64))
        self._looks = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        self.first = 0

    def beside(self, world: PointWorld, T_world_rig: FloatArray, k: int) -> PointWorld:
        """The world with him in it; his points are the last ones."""
        self.first = len(world.points)
        sway = 0.4 * np.sin(2.0 * np.pi * 0.3 * k / _RATE)
        place = T_world_rig @ [1.3, sway, -0.1, 1.0]
        points = np.concatenate([world.points, self._own @ T_world_rig[:3, :3].T + place[:3]])
        return PointWorld(points, np.concatenate([world.descriptors, self._looks]))


def followed(features: Features, index: np.ndarray) -> Features:
    """Features as a front end that follows them names them: tracks are better than what they claim."""
    return replace(features, track_ids=(index + 1).astype(np.int32))


def walked(number: int, *, imu: bool, tracks: bool = True) -> tuple[EkfSlam, list[EkfResult], list[np.ndarray]]:
    """A walk behind somebody with so many features, and which features of each frame are his."""
    rng = np.random.default_rng(7)
    world, companion, slam = room(rng, 700), Companion(number, rng), EkfSlam(EkfSlamConfig())
    samples = iter(readings(_FRAMES / _RATE, rng))
    results, his = [], []
    for k in range(_FRAMES):
        T, stamp = carried(k / _RATE), k * _STEP_NS
        seen = companion.beside(world, T, k) if k >= 20 else world
        while imu and (sample := next(samples)):
            slam.process_imu(sample)
            if sample.stamp_ns >= stamp:
                break
        features, index = seen.features(T, stamp, rng, noise=0.3, max_features=400)
        results.append(slam.process(followed(features, index) if tracks else features))
        his.append(index >= len(world.points))
    return slam, results, his


def error(results: list[EkfResult]) -> float:
    """Error of the way from the first frame to the last, m."""
    start = carried(0.0)
    found = np.linalg.inv(results[0].pose.T) @ results[-1].pose.T
    return float(np.linalg.norm(boxminus(found, np.linalg.inv(start) @ carried((_FRAMES - 1) / _RATE))[:3]))


@pytest.mark.parametrize("imu", [False, True])
def test_somebody_who_walks_ahead_does_not_take_the_map_along(imu: bool) -> None:
    slam, results, his = walked(60, imu=imu)
    assert error(results) < 0.04
    used = [h[r.feature_index].mean() for h, r in zip(his[25:], results[25:], strict=True)]
    assert np.mean(used) < 0.02
    assert slam.counters.counts["frames_with_moving_objects"] > 30
    assert slam.counters.counts["features_on_moving_objects"] > 20 * 30


def test_what_is_not_sure_is_said_unless_an_imu_tells() -> None:
    _, alone, _ = walked(120, imu=False)
    said = [r for r in alone[20:] if r.state is TrackingState.DEGRADED]
    assert len(said) > 20
    assert "moving objects" in said[0].reason
    _, with_imu, _ = walked(120, imu=True)
    assert sum(r.state is TrackingState.DEGRADED for r in with_imu[20:]) < 3
    assert error(with_imu) < 0.04


def test_an_imu_tells_also_of_features_that_are_not_followed() -> None:
    _, results, _ = walked(150, imu=True, tracks=False)
    assert error(results) < 0.04


def test_a_room_where_nothing_moves_has_one_motion() -> None:
    slam, results, _ = walked(0, imu=False)
    assert "frames_with_moving_objects" not in slam.counters.counts
    assert all(r.state is TrackingState.OK for r in results)


def test_the_newest_tracks_are_remembered() -> None:
    tracks = MovingTracks()
    tracks.mark(np.array([0, 3, 5]))
    assert tracks.marks(np.array([0, 3, 4, 5])).tolist() == [False, True, False, True]
    tracks.mark(np.arange(1000, 1500))
    assert tracks.marks(np.array([3, 1499])).tolist() == [False, True]


def test_a_frame_that_tells_the_pose_alone_remembers_nobody() -> None:
    """The map is to the byte the one without such frames, also where somebody walks in them."""
    rng = np.random.default_rng(7)
    world, companion, frames = room(rng, 700), Companion(60, rng), []
    for k in range(_FRAMES):
        T, stamp, maps = carried(k / _RATE), k * _STEP_NS, k % 2 == 0
        seen = world if k < 20 else companion.beside(world, T, k)
        features, index = seen.features(T, stamp, rng, noise=0.3, max_features=400)
        features = followed(features, index)
        source = np.full(len(features), FeatureSource.PREDICTED, np.uint8)
        frames.append(features if maps else replace(features, sigma_depth=0.25 * features.depth, source=source))
    maps = []
    for chosen in (frames[:-1], frames[:-1:2]):
        slam = EkfSlam(EkfSlamConfig())
        results = [slam.process(features) for features in chosen]
        assert slam.counters.counts["frames_with_moving_objects"] > 0
        maps.append([s.covariance for r in results for s in r.submaps] + [s.covariance for s in slam.finish()])
    for with_them, without in zip(*maps, strict=True):
        np.testing.assert_array_equal(with_them, without)
