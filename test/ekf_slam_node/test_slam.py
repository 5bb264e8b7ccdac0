# SPDX-License-Identifier: Apache-2.0
"""The estimator frame by frame on simulated features: accuracy, submaps, loss, rejection of what is wrong."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig, LandmarkConfig
from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.models import Observation
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from ekf_slam_node.submaps.open_submap import most_telling
from feature_world import PointWorld, loop, room
from slam_core.config import from_mapping
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_exp
from slam_core.types import Features, Submap

STEP_NS = 100_000_000


@pytest.fixture
def world(rng: np.random.Generator) -> PointWorld:
    return room(rng)


def run(
    slam: EkfSlam, world: PointWorld, poses: list[FloatArray], rng: np.random.Generator, step_ns: int = STEP_NS
) -> list[EkfResult]:
    return [slam.process(world.features(T, k * step_ns, rng)[0]) for k, T in enumerate(poses)]


def error_of(result: EkfResult, poses: list[FloatArray], index: int) -> FloatArray:
    return boxminus(invert_transform(poses[0]) @ poses[index], result.pose.T)


def submaps_of(results: list[EkfResult], slam: EkfSlam) -> list[Submap]:
    return [submap for result in results for submap in result.submaps] + list(slam.finish())


def test_handheld_loop_is_accurate_and_chained(world: PointWorld, rng: np.random.Generator) -> None:
    poses, slam = loop(100, handheld=0.02), EkfSlam(EkfSlamConfig(agent="a"))
    results = run(slam, world, poses, rng)
    assert all(result.state is TrackingState.OK for result in results)
    error = error_of(results[-1], poses, 99)
    assert np.linalg.norm(error[:3]) < 0.1
    assert np.linalg.norm(error[3:]) < 0.03
    submaps = submaps_of(results, slam)
    assert [submap.index for submap in submaps] == list(range(len(submaps)))
    assert len(submaps) >= 7
    assert [submap.follows_previous for submap in submaps] == [False] + [True] * (len(submaps) - 1)
    for before, after in pairwise(submaps):
        assert before.end_stamp_ns == after.start_stamp_ns
        assert len(np.intersect1d(before.landmark_ids, after.landmark_ids)) >= 15


def test_submap_is_a_proper_joint_gaussian(world: PointWorld, rng: np.random.Generator) -> None:
    slam = EkfSlam(EkfSlamConfig(agent="a"))
    submap = submaps_of(run(slam, world, loop(30), rng), slam)[0]
    assert np.linalg.eigvalsh(submap.covariance)[0] > 0.0
    np.testing.assert_array_equal(submap.path[0].T, np.eye(4))
    np.testing.assert_array_equal(submap.path[-1].T, submap.end_pose)
    np.testing.assert_allclose(submap.path[-1].covariance, submap.covariance[:6, :6], atol=1e-12)
    assert len(np.unique(submap.landmark_ids)) == len(submap.landmark_ids)


def test_same_input_gives_the_same_bytes(world: PointWorld) -> None:
    ends = []
    for _ in range(2):
        rng = np.random.default_rng(3)
        ends.append(run(EkfSlam(EkfSlamConfig()), world, loop(25), rng)[-1].pose)
    np.testing.assert_array_equal(ends[0].T, ends[1].T)
    np.testing.assert_array_equal(ends[0].covariance, ends[1].covariance)


def blank(features: Features) -> Features:
    return features.select(np.zeros(0, dtype=np.int64))


def test_blackout_is_said_at_once_and_the_old_map_is_found_again(world: PointWorld, rng: np.random.Generator) -> None:
    poses, slam = loop(60), EkfSlam(EkfSlamConfig())
    results = []
    for k, T in enumerate(poses):
        features, _ = world.features(T, k * STEP_NS, rng)
        results.append(slam.process(blank(features) if 20 <= k < 25 else features))
    assert [r.state for r in results[20:25]] == [TrackingState.LOST] * 5
    sizes = [np.trace(r.pose.covariance) for r in results[19:25]]
    assert all(b > a for a, b in pairwise(sizes))
    assert all(r.state is TrackingState.OK for r in results[25:])
    assert np.linalg.norm(error_of(results[30], poses, 30)[:3]) < 0.05
    assert all(s.follows_previous for r in results for s in r.submaps[1:])


def test_another_place_begins_a_submap_that_does_not_follow(rng: np.random.Generator) -> None:
    slam, here, there = EkfSlam(EkfSlamConfig()), room(rng), room(rng)
    poses = loop(40)
    results = []
    for k, T in enumerate(poses):
        results.append(slam.process((here if k < 20 else there).features(T, k * STEP_NS, rng)[0]))
    assert results[20].state is TrackingState.LOST
    assert results[-1].state is TrackingState.OK
    submaps = submaps_of(results, slam)
    broken = [s for s in submaps[1:] if not s.follows_previous]
    assert len(broken) == 1
    before = submaps[submaps.index(broken[0]) - 1]
    assert not np.intersect1d(before.landmark_ids, broken[0].landmark_ids).size
    assert before.end_stamp_ns == 19 * STEP_NS


def test_the_map_hears_of_another_place_within_a_second(rng: np.random.Generator) -> None:
    """By then it may have recognised it; a submap that begins otherwise is longer."""
    slam, here, there, step_ns = EkfSlam(EkfSlamConfig()), room(rng), room(rng), 50_000_000
    results = []
    for k, T in enumerate(loop(400)[:100]):
        results.append(slam.process((here if k < 50 else there).features(T, k * step_ns, rng)[0]))
    arrived = next(k for k, r in enumerate(results) if r.submaps and not r.submaps[-1].follows_previous and k > 55)
    lost = results[arrived].submaps[-1]
    assert lost.index > 0
    assert (arrived - 50) * step_ns < 1_000_000_000
    assert len(lost.path) >= 5
    assert max(s.end_stamp_ns - s.start_stamp_ns for r in results for s in r.submaps[:1]) > 1_000_000_000


@pytest.mark.parametrize("rate", [5.0, 2.0])
def test_large_steps_are_bridged_by_a_motion_guess(world: PointWorld, rng: np.random.Generator, rate: float) -> None:
    steps = int(6 * rate)
    poses, slam = loop(steps, rate), EkfSlam(EkfSlamConfig())
    results = run(slam, world, poses, rng, int(1e9 / rate))
    assert all(result.state is TrackingState.OK for result in results)
    error = error_of(results[-1], poses, steps - 1)
    assert np.linalg.norm(error[:3]) < 0.2


def test_moving_crowd_is_not_mapped(world: PointWorld, rng: np.random.Generator) -> None:
    """A fifth of the points walks at 1 m/s: hardly any may stay a landmark (along a distant ray it cannot be seen)."""
    poses, slam = loop(40), EkfSlam(EkfSlamConfig())
    moving = rng.random(len(world.points)) < 0.2
    seen: dict[int, list[bool]] = {}
    for k, T in enumerate(poses):
        shifted = PointWorld(world.points + np.outer(moving, [0.1 * k, 0.0, 0.0]), world.descriptors)
        features, index = shifted.features(T, k * STEP_NS, rng)
        result = slam.process(features)
        for landmark, feature in zip(result.landmark_ids, result.feature_index, strict=True):
            seen.setdefault(int(landmark), []).append(bool(moving[index[feature]]))
    share = np.mean([any(flags) for flags in seen.values() if len(flags) >= 5])
    assert share < 0.03
    assert np.linalg.norm(error_of(result, poses, 39)[:3]) < 0.06


def test_bad_features_are_counted_and_left_out(world: PointWorld, rng: np.random.Generator) -> None:
    slam = EkfSlam(EkfSlamConfig())
    for k, T in enumerate(loop(10)):
        features, _ = world.features(T, k * STEP_NS, rng)
        depth = features.depth.copy()
        depth[:3] = [np.nan, -1.0, np.inf]
        descriptors = features.descriptors.copy()
        descriptors[3] = np.nan
        result = slam.process(dataclasses.replace(features, depth=depth, descriptors=descriptors))
    assert slam.counters.counts["features_unusable"] >= 40
    assert result.state is TrackingState.OK
    assert np.isfinite(result.pose.covariance).all()


def test_old_and_repeated_frames_change_nothing(world: PointWorld, rng: np.random.Generator) -> None:
    slam = EkfSlam(EkfSlamConfig())
    poses = loop(10)
    last = run(slam, world, poses, rng)[-1]
    for stamp in (9 * STEP_NS, 3 * STEP_NS):
        again = slam.process(world.features(poses[2], stamp, rng)[0])
        assert again.state is TrackingState.DEGRADED
        np.testing.assert_array_equal(again.pose.T, last.pose.T)
    assert slam.counters.counts["stamp_not_newer"] == 2


def test_empty_beginning_is_degraded_then_recovers(world: PointWorld, rng: np.random.Generator) -> None:
    slam = EkfSlam(EkfSlamConfig())
    states = []
    for k, T in enumerate(loop(20)):
        features, _ = world.features(T, k * STEP_NS, rng)
        states.append(slam.process(blank(features) if k < 3 else features).state)
    assert states[0] is TrackingState.DEGRADED
    assert states[-1] is TrackingState.OK


def test_a_new_session_keeps_the_open_submap_and_begins_anew(world: PointWorld, rng: np.random.Generator) -> None:
    slam = EkfSlam(EkfSlamConfig())
    results = run(slam, world, loop(20), rng)
    closed = slam.start_session()
    assert len(closed) == 1
    assert {s.session for r in results for s in r.submaps} | {closed[0].session} == {0}
    results = run(slam, world, loop(20), rng)  # stamps of the past
    np.testing.assert_array_equal(results[0].pose.T, np.eye(4))
    assert len(results[0].landmark_ids) == 0
    submaps = [s for r in results for s in r.submaps] + list(slam.finish())
    assert [(s.session, s.index) for s in submaps] == [(1, k) for k in range(len(submaps))]
    assert not submaps[0].follows_previous


def test_wrong_mounting_is_refused() -> None:
    with pytest.raises(ValueError, match="rigid"):
        EkfSlam(EkfSlamConfig(), np.diag([1.0, 1.0, -1.0, 1.0]))


def test_configuration_by_name() -> None:
    config = from_mapping(EkfSlamConfig, {"submap.start": "conditional", "motion.sigma_acceleration": 1})
    assert config.submap.start == "conditional"
    with pytest.raises(ValueError, match="did you mean"):
        from_mapping(EkfSlamConfig, {"submap.max_distence": 2.0})


@pytest.mark.parametrize("gap_s", [30, 7200])
def test_a_long_silence_at_one_place_is_bridged(world: PointWorld, rng: np.random.Generator, gap_s: int) -> None:
    """The old map is found again, and no variance that grew in the meantime has eaten the digits."""
    poses, slam = loop(24), EkfSlam(EkfSlamConfig())
    for k, T in enumerate(poses):
        stamp = k * STEP_NS + (gap_s * 10**9 if k >= 12 else 0)
        result = slam.process(world.features(T, stamp, rng)[0])
        assert result.state is TrackingState.OK
    assert np.linalg.norm(error_of(result, poses, 23)[:3]) < 0.06
    for submap in slam.finish():
        assert np.linalg.eigvalsh(submap.covariance)[0] > 0.0


def test_a_rig_at_rest_stays_where_it_is(world: PointWorld, rng: np.random.Generator) -> None:
    pose, slam = loop(2)[0], EkfSlam(EkfSlamConfig())
    for k in range(40):
        result = slam.process(world.features(pose, k * STEP_NS, rng)[0])
    assert result.state is TrackingState.OK
    assert np.linalg.norm(result.pose.T[:3, 3]) < 0.01
    assert len(slam.finish()) == 1


def test_finish_closes_once_and_the_next_frame_begins_anew(world: PointWorld, rng: np.random.Generator) -> None:
    poses, slam = loop(200), EkfSlam(EkfSlamConfig())
    last = run(slam, world, poses[:10], rng)[-1]
    assert len(slam.finish()) == 1
    assert slam.finish() == ()
    stale = slam.process(world.features(poses[3], 3 * STEP_NS, rng)[0])
    assert stale.state is TrackingState.DEGRADED
    np.testing.assert_array_equal(stale.pose.T, last.pose.T)
    for k in range(10, 15):
        result = slam.process(world.features(poses[k], k * STEP_NS, rng)[0])
    assert result.state is TrackingState.OK
    (submap,) = slam.finish()
    assert (submap.index, submap.follows_previous) == (1, False)


def test_descriptors_of_another_size_are_refused(world: PointWorld, rng: np.random.Generator) -> None:
    poses, slam = loop(60), EkfSlam(EkfSlamConfig())
    run(slam, world, poses[:6], rng)
    features, _ = world.features(poses[6], 6 * STEP_NS, rng)
    odd = slam.process(dataclasses.replace(features, descriptors=features.descriptors[:, :32]))
    assert odd.state is TrackingState.DEGRADED
    assert "32" in odd.reason
    assert slam.process(features).state is TrackingState.OK


@pytest.mark.parametrize("turn_deg", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0])
def test_a_motion_that_contradicts_the_prediction_is_measured(
    world: PointWorld, rng: np.random.Generator, turn_deg: float
) -> None:
    """A jerk of any size is either within every feature's gate, or a surprise that the prediction makes room for."""
    slam, poses = EkfSlam(EkfSlamConfig()), loop(60)
    jerk = make_transform(so3_exp(np.radians([0.0, 0.0, turn_deg])), np.zeros(3))
    poses = [*poses[:8], poses[8] @ jerk]
    results = run(slam, world, poses, rng)
    assert "updates_failed" not in slam.counters.counts
    assert len(results[-1].landmark_ids) > 30
    assert np.linalg.norm(error_of(results[-1], poses, 8)[3:]) < 0.01


def test_an_update_that_fails_is_counted_and_the_run_goes_on(
    world: PointWorld, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, poses = EkfSlam(EkfSlamConfig()), loop(30)
    update = Ekf.update

    def without_rows(ekf: Ekf, z: FloatArray, variance: FloatArray, seen: Observation, slots: np.ndarray, *_: object):
        nobody = np.zeros(0, dtype=np.int64)
        return update(ekf, z[:0], variance[:0], seen.select(nobody), slots[:0])

    run(slam, world, poses[:10], rng)
    monkeypatch.setattr(Ekf, "update", without_rows)
    result = slam.process(world.features(poses[10], 10 * STEP_NS, rng)[0])
    assert result.state is TrackingState.DEGRADED
    assert slam.counters.counts["updates_failed"] == 1
    monkeypatch.undo()
    for k in range(11, 30):
        result = slam.process(world.features(poses[k], k * STEP_NS, rng)[0])
    assert result.state is TrackingState.OK
    assert np.linalg.norm(error_of(result, poses, 29)[:3]) < 0.1


@pytest.mark.parametrize("spoil", ["mean", "covariance"])
def test_an_estimate_that_is_not_finite_costs_one_submap(
    world: PointWorld, rng: np.random.Generator, spoil: str
) -> None:
    slam, poses = EkfSlam(EkfSlamConfig()), loop(60)
    before = run(slam, world, poses[:30], rng)
    if spoil == "mean":
        slam._chain.local._ekf.velocity[:] = np.nan
    else:
        slam._chain.local._ekf.covariance.set_head(np.full((slam._chain.local._ekf.covariance.size, 12), np.inf))
    after = [slam.process(world.features(poses[k], k * STEP_NS, rng)[0]) for k in range(30, 60)]
    assert slam.counters.counts["submaps_abandoned"] == 1
    assert after[0].state is TrackingState.LOST
    assert after[-1].state is TrackingState.OK
    assert all(np.isfinite(r.pose.T).all() and np.isfinite(r.pose.covariance).all() for r in after)
    submaps = submaps_of(before + after, slam)
    assert sum(not s.follows_previous for s in submaps) == 2
    for submap in submaps:
        assert np.linalg.eigvalsh(submap.covariance)[0] > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_features_out_of_all_proportion_do_not_end_a_run(world: PointWorld, seed: int) -> None:
    rng, slam = np.random.default_rng(seed), EkfSlam(EkfSlamConfig())
    for k, T in enumerate(loop(15)):
        features, _ = world.features(T, k * STEP_NS, rng)
        uv, depth, sigma = features.uv.copy(), features.depth.copy(), features.sigma_depth.copy()
        wild = rng.random(len(depth)) < 0.3
        uv[wild] *= 10.0 ** rng.uniform(-3, 6, (wild.sum(), 2)).astype(np.float32)
        depth[wild] *= 10.0 ** rng.uniform(-1, 30, wild.sum()).astype(np.float32)
        sigma[wild] = depth[wild] * 10.0 ** rng.uniform(-8, 0, wild.sum()).astype(np.float32)
        features = dataclasses.replace(features, uv=uv, depth=depth, sigma_depth=sigma)
        result = slam.process(features)
        assert np.isfinite(result.pose.T).all()
        assert np.isfinite(result.pose.covariance).all()
    for submap in slam.finish():
        assert np.linalg.eigvalsh(submap.covariance)[0] > 0.0


def test_a_rig_that_stands_maps_nothing_and_goes_on_when_it_moves(world: PointWorld, rng: np.random.Generator) -> None:
    course = loop(60)
    poses, slam = course[:10] + [course[9]] * 60 + course[10:30], EkfSlam(EkfSlamConfig())
    results = run(slam, world, poses, rng)
    assert slam.counters.counts["frames_standing"] > 40
    held = [r for r in results[20:69] if not len(r.landmark_ids)]
    assert len(held) > 40
    drift = [np.linalg.norm(r.pose.T[:3, 3] - held[0].pose.T[:3, 3]) for r in held]
    assert max(drift) < 0.003
    assert not any(r.submaps for r in results[20:69])
    assert results[-1].state is TrackingState.OK
    assert np.linalg.norm(error_of(results[-1], poses, 89)[:3]) < 0.05


def test_a_rig_that_creeps_is_not_held_back(world: PointWorld, rng: np.random.Generator) -> None:
    start = loop(2)[0]
    poses = [start @ make_transform(np.eye(3), np.array([0.0005 * k, 0.0, 0.0])) for k in range(200)]
    slam = EkfSlam(EkfSlamConfig())
    results = run(slam, world, poses, rng)
    errors = [np.linalg.norm(error_of(result, poses, k)[:3]) for k, result in enumerate(results)]
    assert max(errors) < 0.01


@pytest.mark.parametrize("followed", [True, False])
def test_a_followed_frame_is_measured_by_the_landmarks_that_tell_most(rng: np.random.Generator, followed: bool) -> None:
    """All landmarks in sight count as seen; frames without tracks are measured by all of them."""
    world, config = room(rng, 400), EkfSlamConfig(landmark=LandmarkConfig(most_measured=20))
    slam = EkfSlam(config)
    results = []
    for k in range(8):
        pose = make_transform(np.eye(3), np.array([0.05 * k, 0.0, 0.0]))
        features, index = world.features(pose, 100_000_000 * k, rng, max_features=90)
        tracks = (index + 1).astype(np.int32) if followed else np.zeros(len(index), np.int32)
        results.append(slam.process(dataclasses.replace(features, track_ids=tracks)))
    for result in results[2:]:
        seen = len(result.landmark_ids)
        assert seen > 40
        assert result.nis_dof == (60 if followed else 3 * seen)
    assert boxminus(results[-1].pose.T, pose)[:3] == pytest.approx(np.zeros(3), abs=0.03)


def test_those_that_tell_most_are_chosen_among_the_good() -> None:
    information = np.array([1.0, 5.0, 3.0, 4.0, 9.0, 4.0])
    assert most_telling(information, np.array([0, 1, 2, 3, 5]), 2).tolist() == [1, 3]
    assert most_telling(information, np.array([5, 0]), 9).tolist() == [0, 5]
