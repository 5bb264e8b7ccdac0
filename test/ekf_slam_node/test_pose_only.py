# SPDX-License-Identifier: Apache-2.0
"""Frames that tell the pose alone: where the rig is, as surely as is said, and a map that does not know of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.ride_filter import HeightAt
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from ekf_slam_node.submaps.submap_builder import SubmapBuilder
from feature_world import CAMERA, PointWorld, loop, room
from slam_core.geometry import FloatArray, boxminus, invert_transform
from slam_core.types import Features, FeatureSource, PoseEstimate, RelativeMotion, Submap

STEP_NS = 50_000_000


def tracked(
    world: PointWorld, T: FloatArray, k: int, rng: np.random.Generator, is_pose_only: bool, seen: float = 0.8
) -> Features:
    """Features of frame ``k`` with tracks; of one that tells the pose alone with the depths of a bad prediction."""
    features, index = world.features(T, k * STEP_NS, rng, detection=seen)
    features = dataclasses.replace(features, track_ids=(index + 1).astype(np.int32))
    if not is_pose_only:
        return features
    depth = (features.depth * rng.uniform(0.9, 1.1, len(features))).astype(np.float32)
    return dataclasses.replace(
        features,
        depth=depth,
        xyz=CAMERA.unproject(features.uv.astype(np.float64), depth.astype(np.float64)).astype(np.float32),
        sigma_depth=0.25 * depth,
        source=np.full(len(features), FeatureSource.PREDICTED, np.uint8),
    )


def run(frames: list[Features]) -> tuple[list[EkfResult], list[Submap], EkfSlam]:
    slam = EkfSlam(EkfSlamConfig(agent="a"))
    results = [slam.process(frame) for frame in frames]
    return results, [s for r in results for s in r.submaps] + list(slam.finish()), slam


def stamps_of(submaps: list[Submap]) -> list[int]:
    """Stamps of the paths one after the other, those of a submap's end and the next one's start once."""
    paths = [[p.stamp_ns for p in submap.path] for submap in submaps]
    return paths[0] + [stamp for path in paths[1:] for stamp in path[1:]]


def walk(rng: np.random.Generator, steps: int = 60, every: int = 3) -> tuple[list[Features], list[FloatArray]]:
    """Frames of a walk, of which each ``every``-th maps, and their poses seen from the first."""
    world, poses = room(rng), loop(240, turns=1.0)[:steps]
    frames = [tracked(world, T, k, rng, k % every != 0) for k, T in enumerate(poses)]
    return frames, [invert_transform(poses[0]) @ T for T in poses]


def test_the_map_is_that_of_the_frames_that_map(rng: np.random.Generator) -> None:
    frames, _ = walk(rng)
    _, between, _ = run(frames)
    _, alone, _ = run([frame for frame in frames if not frame.is_pose_only] + frames[-1:])
    assert len(between) == len(alone) > 1
    for one, other in zip(between, alone, strict=True):
        np.testing.assert_array_equal(one.landmarks, other.landmarks)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert [p.stamp_ns for p in one.path][-1] == other.path[-1].stamp_ns
    assert stamps_of(between) == [frame.stamp_ns for frame in frames], "each frame has one pose in the map, in order"


def test_poses_are_accurate_on_the_way(rng: np.random.Generator) -> None:
    frames, poses = walk(rng, steps=36)
    results, _, slam = run(frames)
    for result, frame, pose in zip(results[6:], frames[6:], poses[6:], strict=True):
        if frame.is_pose_only:
            assert result.state is TrackingState.OK
            assert np.linalg.norm(boxminus(pose, result.pose.T)[:3]) < 0.05
    assert slam.counters.counts["frames_pose_only"] == sum(f.is_pose_only for f in frames)


def test_poses_are_as_sure_as_they_say(rng: np.random.Generator) -> None:
    """NEES right after the first frame, whose pose is exact: all of the error is that of the motion found."""
    nees = []
    for _ in range(40):
        frames, poses = walk(rng, steps=3)
        for pose, result in zip(poses[1:], run(frames)[0][1:], strict=True):
            error = boxminus(pose, result.pose.T)
            nees.append(error @ np.linalg.solve(result.pose.covariance, error))
    assert 0.6 < np.mean(nees) / 6 < 1.5


def test_finish_ends_at_the_last_frame(rng: np.random.Generator) -> None:
    frames, _ = walk(rng, steps=24)  # the last two tell the pose alone
    assert frames[-1].is_pose_only
    _, submaps, _ = run(frames)
    end = submaps[-1].path[-1]
    assert end.stamp_ns == frames[-1].stamp_ns
    np.testing.assert_array_equal(end.T, submaps[-1].end_pose)


def test_a_frame_that_cannot_be_linked_finds_the_filter_at_the_last_that_was(rng: np.random.Generator) -> None:
    frames, poses = walk(rng, steps=24)
    nothing = dataclasses.replace(frames[21], stamp_ns=frames[-1].stamp_ns + STEP_NS).select(np.zeros(0, np.int64))
    results, submaps, slam = run([*frames, nothing])
    assert results[-1].state is TrackingState.LOST
    assert slam.counters.counts["frames_lost"] == 1
    assert stamps_of(submaps) == [frame.stamp_ns for frame in frames]
    error = boxminus(poses[-1], results[-2].pose.T)
    assert np.linalg.norm(error[:3]) < 0.05


def test_unlinked_pose_only_frames_begin_no_map(rng: np.random.Generator) -> None:
    """Features without a depth are no places to begin with: the next frame that maps decides."""
    frames, _ = walk(rng, steps=13)
    elsewhere, _ = walk(rng, steps=20)
    strange = [f for f in elsewhere if f.is_pose_only][:4]
    strange = [dataclasses.replace(f, stamp_ns=frames[-1].stamp_ns + (k + 1) * STEP_NS) for k, f in enumerate(strange)]
    strange = [dataclasses.replace(f, track_ids=f.track_ids + 5000) for f in strange]
    results, submaps, slam = run([*frames, *strange])
    assert [r.state for r in results[-4:]] == [TrackingState.LOST] * 4
    assert slam.counters.counts["frames_lost"] == 4
    assert not any(r.submaps for r in results[-4:])
    assert submaps[-1].path[-1].stamp_ns == frames[-1].stamp_ns


def test_features_tell_whether_they_map(rng: np.random.Generator) -> None:
    frame = tracked(room(rng), np.eye(4), 0, rng, is_pose_only=True)
    assert frame.is_pose_only
    measured = frame.source.copy()
    measured[3] = FeatureSource.STEREO
    assert not dataclasses.replace(frame, source=measured).is_pose_only
    assert not frame.select(np.zeros(0, np.int64)).is_pose_only


def test_a_standing_rig_has_its_poses(rng: np.random.Generator) -> None:
    world = room(rng)
    frames = [tracked(world, np.eye(4), k, rng, k % 2 == 1) for k in range(20)]
    results, submaps, _ = run(frames)
    assert max(np.linalg.norm(r.pose.T[:3, 3]) for r in results) < 0.02
    assert submaps[-1].path[-1].stamp_ns == frames[-1].stamp_ns


def test_a_filter_that_hears_of_no_mapping_frame_goes_on(rng: np.random.Generator) -> None:
    """They may be left out on the way, and another front end may never measure a depth."""
    frames, _ = walk(rng, steps=120, every=1000)
    results, _, _ = run(frames)
    assert sum(r.state is TrackingState.LOST for r in results) < 40
    assert results[-1].state is TrackingState.OK


def test_where_images_say_nothing_scans_tell_the_pose(rng: np.random.Generator) -> None:
    frames, poses = walk(rng, steps=6)
    strange = dataclasses.replace(frames[5], track_ids=frames[5].track_ids + 5000, descriptors=-frames[5].descriptors)
    slam = EkfSlam(EkfSlamConfig(agent="a"))
    for frame in frames[:4]:
        slam.process(frame)
    step = invert_transform(poses[3]) @ poses[5]
    slam.process_motion(RelativeMotion(frames[3].stamp_ns, frames[5].stamp_ns, step, np.eye(6) * 1e-8))
    result = slam.process(strange)
    assert (result.state, slam.counters.counts["frames_bridged"]) == (TrackingState.DEGRADED, 1)
    assert np.linalg.norm(boxminus(poses[5], result.pose.T)[:3]) < 0.02


def test_frames_that_never_map_begin_a_map_in_the_end(rng: np.random.Generator) -> None:
    """If none that maps comes within half a second, frames elsewhere that link to each other do."""
    frames, _ = walk(rng, steps=4)
    elsewhere, _ = walk(rng, steps=24, every=1000)
    for k, frame in enumerate(elsewhere[1:]):
        ids = frame.track_ids + 5000
        frames.append(dataclasses.replace(frame, stamp_ns=(4 + k) * STEP_NS, track_ids=ids))
    states = [r.state for r in run(frames)[0]]
    assert states[4:12] == [TrackingState.LOST] * 8
    assert states[-1] is TrackingState.OK


def test_a_lift_raises_the_poses_between_its_heights(rng: np.random.Generator) -> None:
    frames, _ = walk(rng, steps=7)
    builder = SubmapBuilder("a", 0, frames[0].stamp_ns, False)
    for frame in frames[1:]:
        pose = PoseEstimate(frame.stamp_ns, np.eye(4), 1e-4 * np.eye(6))
        builder.add_located_pose(pose) if frame.is_pose_only else builder.add_pose(pose)
    heights = tuple(HeightAt(frames[k].stamp_ns, 0.5 * k, 0.01 * k) for k in (3, 6))
    builder.raise_path(heights, UpDirection(np.array([0.0, 0.0, 1.0]), np.zeros((3, 3))))
    found = {p.stamp_ns: p for p in builder._path}
    assert [found[frame.stamp_ns].T[2, 3] for frame in frames] == pytest.approx([0, 0, 0, 1.5, 2.0, 2.5, 3.0])
    assert found[frames[4].stamp_ns].covariance[2, 2] == pytest.approx(1e-4 + 0.04)


def test_after_the_end_of_a_map_a_new_one_waits_for_a_frame_that_maps(rng: np.random.Generator) -> None:
    frames, _ = walk(rng, steps=40)
    slam = EkfSlam(EkfSlamConfig(agent="a"))
    for frame in frames[:4]:
        slam.process(frame)
    slam.finish()
    states = [slam.process(frame).state for frame in frames[4:8]]
    assert states == [TrackingState.DEGRADED, TrackingState.DEGRADED, TrackingState.OK, TrackingState.OK]
    slam.finish()
    late = [slam.process(frame) for frame in frames[8:] if frame.is_pose_only]
    assert late[0].state is TrackingState.DEGRADED
    assert late[-1].state is TrackingState.OK, "if none comes within a second, one of these begins"
