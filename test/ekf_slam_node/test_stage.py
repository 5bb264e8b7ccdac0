# SPDX-License-Identifier: Apache-2.0
"""The filter's stage: the order of arrival does not matter, and a stream that dies stops nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from imu_world import carried, readings

from ekf_slam_node.results import TrackingState
from ekf_slam_node.stage import IMU, MOTION, FilterConfig, FilterStage, FrameResult
from feature_world import T_RIG_OPTICAL, loop, room
from slam_core.frame_tree import FrameTree
from slam_core.geometry import invert_transform
from slam_core.types import Features, ImuSample, PressureReading, RelativeMotion

STEP_NS = 100_000_000
FRAMES = 16


@pytest.fixture(scope="module")
def frames_and_motions() -> tuple[list[Features], list[RelativeMotion]]:
    rng = np.random.default_rng(4)
    world, poses = room(rng), loop(FRAMES)
    frames = [world.features(T, (k + 1) * STEP_NS, rng)[0] for k, T in enumerate(poses)]
    motions = [
        RelativeMotion((k + 1) * STEP_NS, (k + 2) * STEP_NS, invert_transform(a) @ b, np.eye(6) * 1e-5)
        for k, (a, b) in enumerate(pairwise(poses))
    ]
    return frames, motions


def stage(frame_id: str, *wait_for: str, patience: int = 10) -> FilterStage:
    tree = FrameTree()
    tree.add("base_link", frame_id, T_RIG_OPTICAL)
    tree.add("base_link", "imu_link", np.eye(4))
    return FilterStage(FilterConfig(wait_for=wait_for, patience=patience), tree)


def run(filter_stage: FilterStage, items: list[Features | RelativeMotion | ImuSample]) -> list[FrameResult]:
    results = []
    for item in items:
        if isinstance(item, Features):
            filter_stage.add_features(item)
        elif isinstance(item, RelativeMotion):
            filter_stage.add_motion(item.end_stamp_ns, item)
        else:
            filter_stage.add_imu(item)
        results += list(filter_stage.ready())
    filter_stage.give_up()
    return results + list(filter_stage.ready())


def stamp_of(item: Features | RelativeMotion | ImuSample) -> int:
    return item.end_stamp_ns if isinstance(item, RelativeMotion) else item.stamp_ns


def imu(stamps: range) -> list[ImuSample]:
    return [ImuSample(s, np.array([0.0, 0.0, 0.01]), np.zeros(3), "imu_link") for s in stamps]


@pytest.mark.parametrize("delay_ns", [0, 3 * STEP_NS, -3 * STEP_NS])
def test_the_order_of_arrival_does_not_change_a_bit(frames_and_motions, delay_ns: int) -> None:
    frames, motions = frames_and_motions
    samples = imu(range(STEP_NS // 2, (FRAMES + 4) * STEP_NS, 7_000_000))
    items = [*frames, *motions, *samples]
    by_stamp = sorted(items, key=stamp_of)
    motions_late = sorted(items, key=lambda i: stamp_of(i) + delay_ns * isinstance(i, RelativeMotion))
    imu_late = sorted(items, key=lambda i: stamp_of(i) + delay_ns * isinstance(i, ImuSample))
    expected = run(stage(frames[0].frame_id, MOTION, IMU), by_stamp)
    for arrival in (motions_late, imu_late):
        got = run(stage(frames[0].frame_id, MOTION, IMU), arrival)
        assert len(got) == len(expected) == FRAMES
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_array_equal(a.estimate.pose.T, b.estimate.pose.T)
            np.testing.assert_array_equal(a.estimate.pose.covariance, b.estimate.pose.covariance)


def test_a_source_of_motions_that_dies_degrades_and_is_used_again(frames_and_motions) -> None:
    frames, motions = frames_and_motions
    heard = motions[:3] + motions[11:]
    filter_stage = stage(frames[0].frame_id, MOTION, patience=3)
    results = run(filter_stage, sorted([*frames, *heard], key=stamp_of))
    assert len(results) == FRAMES
    states = [r.estimate.state for r in results]
    assert set(states[:4]) == {TrackingState.OK}
    assert states[8] is TrackingState.DEGRADED
    assert "no motion since 0.400 s" in results[8].estimate.reason
    assert states[-1] is TrackingState.OK
    used = filter_stage.counters.counts
    assert used["aids_used"] == len(heard)


def test_a_source_of_motions_that_never_lived_delays_only_the_first_frames(frames_and_motions) -> None:
    frames, _ = frames_and_motions
    filter_stage, counts = stage(frames[0].frame_id, MOTION, patience=3), []
    for frame in frames:
        filter_stage.add_features(frame)
        counts.append(len(list(filter_stage.ready())))
    assert counts == [0, 0, 0, 4] + [1] * (FRAMES - 4)


def test_frames_do_not_wait_for_a_barometer(frames_and_motions) -> None:
    frames, _ = frames_and_motions
    filter_stage, states = stage(frames[0].frame_id), []
    filter_stage.add_pressure(PressureReading(frames[0].stamp_ns, 1e5))
    for frame in frames:
        filter_stage.add_features(frame)
        states += [result.estimate.state for result in filter_stage.ready()]
    assert states == [TrackingState.OK] * FRAMES


def test_an_unknown_stream_is_refused() -> None:
    with pytest.raises(ValueError, match="may hold motion, imu, odometry, got wheels"):
        FilterConfig(wait_for=("wheels",))


@pytest.mark.parametrize("late_ns", [20_000_000, -20_000_000])
def test_an_imu_with_another_clock_is_waited_for_and_told_of(late_ns: int) -> None:
    """Readings before and after the frames, in any order, give the same poses, and the offset is found."""
    rng = np.random.default_rng(5)
    world = room(rng)
    frames = [world.features(carried(0.1 * k), k * STEP_NS, rng, max_features=80)[0] for k in range(1, 61)]
    samples = [replace(s, stamp_ns=s.stamp_ns - late_ns, frame_id="imu_link") for s in readings(6.2, rng)]
    items: list[Features | RelativeMotion | ImuSample] = [*frames, *samples]
    results, findings = [], []
    for delay_ns in (0, 3 * STEP_NS, -3 * STEP_NS):
        filter_stage = stage(frames[0].frame_id, IMU)
        order = sorted(items, key=lambda i: stamp_of(i) + delay_ns * isinstance(i, ImuSample))
        results.append([r.estimate.pose.T for r in run(filter_stage, order)])
        findings.append(filter_stage.clock_finding)
        assert filter_stage.imu_time_offset_s[0] == pytest.approx(1e-9 * late_ns, abs=3e-3)
    assert "ms off, corrected" in findings[0]
    for other in results[1:]:
        np.testing.assert_array_equal(np.array(other), np.array(results[0]))
