# SPDX-License-Identifier: Apache-2.0
"""Cameras back to back on one rig: one filter, honest, that goes on where one of them sees nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from ekf_slam_node.association.motion_guess import guess_motion
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.models import Frame, FrameCamera, project, rig_points
from ekf_slam_node.results import TrackingState
from ekf_slam_node.stage import FilterConfig, FilterStage, FrameResult
from feature_world import CAMERA, T_RIG_OPTICAL, PointWorld
from slam_core.frame_tree import FrameTree
from slam_core.geometry import (
    FloatArray,
    boxminus,
    invert_transform,
    make_transform,
    rotation_from_euler,
    transform_points,
)
from slam_core.types import Features

TURNED = make_transform(rotation_from_euler(np.pi, 0.1, 0.05), np.array([-0.12, 0.03, 0.02]))
MOUNTS = {"front": np.eye(4), "back": TURNED}
MS = 1_000_000


@pytest.fixture(scope="module")
def room() -> PointWorld:
    rng = np.random.default_rng(3)
    points = rng.uniform([-5, -4, -1.5], [5, 4, 1.5], (1500, 3))
    side = rng.integers(0, 4, len(points))
    for number, (axis, value) in enumerate([(0, 5), (0, -5), (1, 4), (1, -4)]):
        points[side == number, axis] = value
    looks = rng.standard_normal((len(points), 64))
    return PointWorld(points, looks / np.linalg.norm(looks, axis=1, keepdims=True))


def pose(t: float) -> FloatArray:
    place = [1.5 * np.sin(0.3 * t), 0.5 * np.cos(0.3 * t), 0.1 * np.sin(t)]
    return make_transform(rotation_from_euler(0.25 * t), np.array(place))


def stage_for(*cameras: str, **options: object) -> FilterStage:
    frames = FrameTree()
    for name, T in MOUNTS.items():
        frames.add("base_link", name, T @ T_RIG_OPTICAL)
    return FilterStage(FilterConfig(cameras=cameras if len(cameras) > 1 else (), **options), frames)  # type: ignore[arg-type]


Change = Callable[[int, str, Features], Features | None]


def walk(
    room: PointWorld, cameras: tuple[str, ...], frames: int = 80, seed: int = 0, change: Change = lambda k, c, f: f,
    late_ms: int = 0,
) -> Iterator[tuple[FloatArray, FrameResult]]:  # fmt: skip
    """True poses and results; ``late_ms``: of the second camera's stamps and pictures."""
    stage, rng = stage_for(*cameras), np.random.default_rng(seed)
    for k in range(frames):
        for number, name in enumerate(cameras):
            t = 0.1 * k + 1e-3 * late_ms * number
            features, _ = room.features(pose(t) @ MOUNTS[name], round(t * 1e9) + 1, rng, max_features=150)
            given = change(k, name, replace(features, frame_id=name))
            if given is not None:
                stage.add_features(given, name)
        for result in stage.ready():
            yield pose((result.estimate.stamp_ns - 1) * 1e-9), result
    stage.give_up()
    for result in stage.ready():
        yield pose((result.estimate.stamp_ns - 1) * 1e-9), result


def errors(run: Iterator[tuple[FloatArray, FrameResult]]) -> tuple[FloatArray, list[str], list[float]]:
    """Distances (n,) m from the truth, states, and NEES of the poses over their dimension."""
    T_start, distances, states, nees = None, [], [], []
    for T, result in run:
        T_start = T if T_start is None else T_start
        true, estimate = invert_transform(T_start) @ T, result.estimate
        difference = boxminus(estimate.pose.T, true)
        distances.append(float(np.linalg.norm(estimate.pose.T[:3, 3] - true[:3, 3])))
        states.append(estimate.state.value)
        nees.append(float(difference @ np.linalg.solve(estimate.pose.covariance, difference)) / 6.0)
    return np.array(distances), states, nees


def blind_front(k: int, name: str, features: Features) -> Features:
    """A blank wall before the front camera for three seconds."""
    return features.select(np.zeros(0, np.int64)) if name == "front" and 30 < k < 60 else features


def test_features_of_both_cameras_are_measured_in_one_update(room: PointWorld) -> None:
    sides = set()
    for k, (_, result) in enumerate(walk(room, ("front", "back"), frames=12)):
        if k > 4 and result.estimate.feature_index is not None:
            sides |= set((np.asarray(result.estimate.feature_index) >= 150).tolist())
    assert sides == {True, False}


def test_two_cameras_are_as_honest_and_no_worse_than_one() -> None:
    rng = np.random.default_rng(5)
    ratios, nees = [], []
    for seed in range(4):
        points = rng.uniform([-5, -4, -1.5], [5, 4, 1.5], (900, 3))
        looks = rng.standard_normal((900, 64))
        world = PointWorld(points, looks / np.linalg.norm(looks, axis=1, keepdims=True))
        one = errors(walk(world, ("front",), seed=seed))[0]
        both, states, own = errors(walk(world, ("front", "back"), seed=seed))
        assert set(states) == {"OK"}
        ratios.append(np.sqrt(np.mean(both**2) / np.mean(one**2)))
        nees.append(np.mean(own[5:]))
    assert np.median(ratios) < 1.0
    assert 0.3 < np.mean(nees) < 2.0


def test_no_frame_is_lost_before_a_blank_wall(room: PointWorld) -> None:
    assert "LOST" in errors(walk(room, ("front",), change=blind_front))[1]
    distances, states, nees = errors(walk(room, ("front", "back"), change=blind_front))
    assert set(states) == {"OK"}
    assert distances.max() < 0.1
    assert np.mean(nees[5:]) < 2.0


@pytest.mark.parametrize("dead", ["front", "back"])
def test_a_camera_that_dies_is_told_and_mapped_without(room: PointWorld, dead: str) -> None:
    def dies(k: int, name: str, features: Features) -> Features | None:
        return None if name == dead and k >= 20 else features

    results = [result.estimate for _, result in walk(room, ("front", "back"), change=dies)]
    assert len(results) == 80
    said = {(r.state, r.reason) for r in results[40:]}
    assert said == {(TrackingState.DEGRADED, f"no camera {dead} since 1.900 s")}


def test_a_camera_of_half_the_rate_takes_part(room: PointWorld) -> None:
    def half(k: int, name: str, features: Features) -> Features | None:
        return None if name == "back" and k % 2 else blind_front(k, name, features)

    distances, states, nees = errors(walk(room, ("front", "back"), change=half))
    assert "LOST" not in states
    assert distances.max() < 0.1
    assert np.mean(nees[5:]) < 2.0


@pytest.mark.parametrize(("late_ms", "told"), [(40, 2), (2000, 12)])
def test_a_camera_without_the_common_trigger_is_told_and_left_out(room: PointWorld, late_ms: int, told: int) -> None:
    alone = errors(walk(room, ("front",), frames=40))[0]
    results = list(walk(room, ("front", "back"), frames=40, late_ms=late_ms))
    assert len(results) == 40
    assert np.median(errors(iter(results))[0]) < 3.0 * np.median(alone)
    reasons = {result.estimate.reason for _, result in results[told:]}
    assert reasons == {"camera back has no common trigger with the others, it is not used"}


def test_pairs_of_all_cameras_give_one_motion() -> None:
    """Where each camera alone sees too few pairs, and a third of all are wrong."""
    rng = np.random.default_rng(8)
    T = make_transform(rotation_from_euler(0.2, 0.05, -0.1), np.array([0.3, -0.1, 0.05]))
    cameras = tuple(
        FrameCamera(CAMERA, invert_transform(T_RIG_OPTICAL) @ mount @ T_RIG_OPTICAL, number)
        for number, mount in enumerate(MOUNTS.values())
    )
    optical = rng.uniform([-1, -0.8, 2], [1, 0.8, 5], (9, 3))
    seen_by = np.array([0, 1, 0, 1, 1, 0, 1, 0, 1], np.uint8)
    z = project(optical, CAMERA)
    frame = Frame(
        1, z, np.full((9, 3), 1e-4), np.zeros((9, 1), np.float32), CAMERA, np.arange(9), np.zeros(9), cameras, seen_by
    )
    now, _ = rig_points(frame, T_RIG_OPTICAL)
    expected = [transform_points(MOUNTS["back" if b else "front"] @ T_RIG_OPTICAL, o[None])[0] for b, o in zip(
        seen_by, optical, strict=True)]  # fmt: skip
    np.testing.assert_allclose(now, expected, atol=1e-12)
    before = transform_points(T, now)
    before[:2] += 1.0
    points = Candidates(before, np.full((9, 3, 3), 1e-6) * np.eye(3), frame.descriptors, frame.tracks)
    guess = guess_motion(points, frame, T_RIG_OPTICAL, rng, 200, 16.0)
    assert guess is not None
    np.testing.assert_allclose(guess.T, T, atol=1e-3)
    np.testing.assert_array_equal(guess.inliers, [False] * 2 + [True] * 7)
    assert np.abs(guess.error[:2]).max() > 1.0
    assert np.abs(guess.error[2:]).max() < 0.1


def test_a_search_for_one_camera_is_refused_for_several() -> None:
    association = replace(FilterConfig().association, method="jcbb")
    with pytest.raises(ValueError, match=r"jcbb.* is for one camera"):
        stage_for("front", "back", association=association)
