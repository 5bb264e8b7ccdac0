# SPDX-License-Identifier: Apache-2.0
"""Tracks of a camera that moves before a wall: where they are, how exactly, and when new ones are wanted."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from slam_core.config import from_mapping
from slam_core.frame_tree import FrameTree
from slam_core.types import DepthImage, Features, FeatureSource, StereoImages
from stereo_frontend.detection.features import TRACKING
from stereo_frontend.fiducials.tag_features import TagFeatures
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import MODES, FrontendConfig
from stereo_frontend.stage import FeatureStage
from stereo_frontend.tracking.frame_motion import facing_warp, fit_motion

STEP_NS = 100_000_000
FLOW = np.array([4.3, -2.2])
"""Motion of the picture from frame to frame, px."""


def tracking_frontend(mode: str = "stereo") -> Frontend:
    """A front end all of whose frames map."""
    wanted = {"features.target": 300, "features.tracking": "always", "features.mapping_interval": 0.0}
    return Frontend(from_mapping(FrontendConfig, {"mode": mode, **wanted}))


def moved(pair: StereoImages, frames: int) -> StereoImages:
    """The pair after so many frames of a camera that goes along the wall; whole pixels, so that the truth is exact."""
    shift = tuple(int(s) for s in np.round(FLOW * frames)[::-1])
    return dataclasses.replace(
        pair,
        stamp_ns=pair.stamp_ns + frames * STEP_NS,
        left=np.roll(pair.left, shift, (0, 1)),
        right=np.roll(pair.right, shift, (0, 1)),
    )


def test_tracks_keep_their_ids_and_places(stereo_pair):
    frontend, pair = tracking_frontend(), stereo_pair()
    first = frontend.process(pair)
    assert (first.track_ids > 0).sum() > 60
    for k in range(1, 5):
        now = frontend.process(moved(pair, k))
        _, before, after = np.intersect1d(first.track_ids, now.track_ids, return_indices=True)
        followed = first.track_ids[before] > 0
        error = (now.uv[after] - first.uv[before])[followed] - np.round(FLOW * k)
        assert followed.sum() > 0.7 * (first.track_ids > 0).sum()
        # What lies over the seam of the rolled pictures jumps; the rest is found to a few hundredths of a pixel.
        assert np.quantile(np.abs(error), 0.9) < 0.05
        assert len(np.unique(now.track_ids)) == len(now)
    assert frontend.counters.counts["key_frames"] == 1


def test_a_frame_that_shows_something_else_becomes_a_key_frame(stereo_pair):
    frontend = tracking_frontend()
    first = frontend.process(stereo_pair(seed=1))
    other = dataclasses.replace(stereo_pair(seed=2), stamp_ns=first.stamp_ns + STEP_NS)
    now = frontend.process(other)
    assert frontend.counters.counts["key_frames"] == 2
    assert len(np.intersect1d(first.track_ids[first.track_ids > 0], now.track_ids)) < 10
    assert len(now) > 60


def test_the_same_frames_give_the_same_bytes(stereo_pair):
    frames = [moved(stereo_pair(), k) for k in range(3)]
    frontend = tracking_frontend()
    once = [frontend.process(frame) for frame in frames]
    frontend.reset()
    again = [frontend.process(frame) for frame in frames]
    for a, b in zip(once, again, strict=True):
        for name in ("uv", "depth", "sigma_uv", "sigma_depth", "descriptors", "track_ids"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def depth_image(frame: StereoImages) -> DepthImage:
    """The left image as that of a depth camera, of a wall at 2 m."""
    depth, grey = np.full(frame.left.shape, 2.0, np.float32), frame.left.astype(np.float32)
    return DepthImage(frame.stamp_ns, depth, np.full_like(depth, 0.004), frame.stereo.camera, grey)


def test_a_depth_camera_is_tracked_too(stereo_pair):
    frontend, pair = tracking_frontend("tof"), stereo_pair()
    counts = [frontend.process(None, depth_image(moved(pair, k))) for k in range(3)]
    common = np.intersect1d(counts[0].track_ids, counts[2].track_ids)
    assert (common > 0).sum() > 60
    np.testing.assert_allclose(counts[2].depth, 2.0, atol=0.01)


def test_a_track_without_depth_measures_its_direction(stereo_pair):
    frontend, pair = tracking_frontend("tof"), stereo_pair()
    depth = np.full(pair.left.shape, 2.0, np.float32)
    hole = np.index_exp[:, pair.left.shape[1] // 2 :]
    frames = []
    for k in range(4):
        frame, seen = moved(pair, k), depth.copy()
        seen[hole] = np.nan if k else 2.0
        camera, grey = pair.stereo.camera, frame.left.astype(np.float32)
        frames.append(frontend.process(None, DepthImage(frame.stamp_ns, seen, np.full_like(seen, 0.004), camera, grey)))
    first, last = frames[0], frames[-1]
    _, _, now = np.intersect1d(first.track_ids, last.track_ids, return_indices=True)
    now = now[last.track_ids[now] > 0]
    blind = now[last.uv[now, 0] > pair.left.shape[1] // 2 + 2]
    sighted = np.setdiff1d(now, now[last.uv[now, 0] > pair.left.shape[1] // 2 - 2])
    assert min(len(blind), len(sighted)) > 20
    np.testing.assert_allclose(last.depth[blind], 2.0, atol=0.05)  # as the camera's motion predicts it
    np.testing.assert_allclose(last.sigma_depth[blind], 0.25 * last.depth[blind], rtol=1e-5)
    assert (last.source[blind] == FeatureSource.PREDICTED).all()
    assert (last.source[sighted] == FeatureSource.TOF).all()
    assert last.sigma_depth[sighted].max() < 0.01
    assert last.sigma_uv[blind].max() < 0.5


def test_the_motion_of_points_is_found_among_outliers(rng):
    from slam_core.camera import Camera
    from slam_core.geometry import make_transform, so3_exp, transform_points

    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0)
    points = camera.unproject(rng.uniform([0, 0], [640, 480], (100, 2)), rng.uniform(1.0, 6.0, 100))
    T = make_transform(so3_exp(np.array([0.02, -0.05, 0.1])), np.array([0.05, 0.02, -0.1]))
    uv = camera.project(transform_points(T, points)) + rng.normal(0.0, 0.1, (100, 2))
    uv[:25] += rng.uniform(5.0, 60.0, (25, 2))
    found = fit_motion(points, uv, camera, np.eye(4))
    assert found is not None
    np.testing.assert_allclose(found, T, atol=3e-3)
    assert fit_motion(points, rng.uniform(0.0, 480.0, (100, 2)), camera, np.eye(4)) is None
    assert fit_motion(points[:5], uv[:5], camera, np.eye(4)) is None


def test_the_warp_of_a_patch_that_faces_the_camera_is_the_derivative_of_its_places(rng):
    from slam_core.geometry import make_transform, so3_exp

    T = make_transform(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.2, 0.1, -0.3]))
    point = np.array([[0.4, -0.3, 2.0]])

    def place(xy: np.ndarray) -> np.ndarray:
        moved_point = T[:3, :3] @ (2.0 * np.append(xy, 1.0)) + T[:3, 3]
        return moved_point[:2] / moved_point[2]

    xy, h = point[0, :2] / 2.0, 1e-6
    columns = [(place(xy + h * e) - place(xy - h * e)) / (2.0 * h) for e in np.eye(2)]
    assert facing_warp(T, point)[0] == pytest.approx(np.column_stack(columns).ravel(), abs=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_all_modes_with_a_pair_are_tracked_by_themselves(mode):
    def tracks(tracking: str) -> bool:
        return from_mapping(FrontendConfig, {"mode": mode, "features.tracking": tracking}).tracks

    assert [tracks(t) for t in TRACKING] == [mode != "tof", True, False]


def test_new_tracks_begin_where_there_are_none(stereo_pair, rng):
    frontend = tracking_frontend()
    frontend.process(stereo_pair())
    tracker = frontend._tracker
    occupied = tracker._tracks.keypoints.uv
    assert not tracker.is_free(occupied + np.float32(3.0)).any()
    places = rng.uniform(0.0, 400.0, (500, 2)).astype(np.float32)
    nearest = np.linalg.norm(places[:, None].astype(float) - occupied[None], axis=2).min(axis=1)
    np.testing.assert_array_equal(tracker.is_free(places), nearest > 8.0)


def test_a_track_is_no_surer_than_a_share_of_its_keypoint(stereo_pair):
    frontend, pair = tracking_frontend(), stereo_pair()
    first, now = frontend.process(pair), frontend.process(moved(pair, 1))
    _, before, after = np.intersect1d(first.track_ids, now.track_ids, return_indices=True)
    followed = first.track_ids[before] > 0
    ratio = (now.sigma_uv[after] / first.sigma_uv[before])[followed]
    assert followed.sum() > 60
    assert ratio.min() > 0.4


def test_tracks_of_another_camera_are_forgotten(stereo_pair):
    frontend, pair = tracking_frontend(), moved(stereo_pair(), 1)
    first = frontend.process(stereo_pair())
    camera = dataclasses.replace(pair.stereo.camera, fx=210.0, fy=210.0)
    other = frontend.process(dataclasses.replace(pair, stereo=dataclasses.replace(pair.stereo, camera=camera)))
    assert frontend.counters.counts["key_frames"] == 2
    assert (other.track_ids > 0).sum() > 60
    assert len(np.intersect1d(first.track_ids[first.track_ids > 0], other.track_ids)) == 0


@pytest.mark.parametrize(("mode", "step_s", "is_followed"), [
    ("stereo", 0.2, True), ("stereo", 0.5, False), ("tof", 0.1, True), ("tof", 0.2, False),
])  # fmt: skip
def test_pictures_far_apart_in_time_are_detected_anew(stereo_pair, mode, step_s, is_followed):
    def features(frame: StereoImages) -> Features:
        return frontend.process(None, depth_image(frame)) if mode == "tof" else frontend.process(frame)

    frontend, pair = tracking_frontend(mode), stereo_pair()
    first = features(pair)
    now = features(dataclasses.replace(moved(pair, 1), stamp_ns=pair.stamp_ns + round(1e9 * step_s)))
    followed = np.intersect1d(first.track_ids, now.track_ids[now.track_ids > 0])
    assert (len(followed) > 60) == is_followed
    assert is_followed or (len(followed) == 0 and len(now) > 0.9 * len(first))


def frames_of(frontend: Frontend, stereo_pair, count: int) -> list[Features]:
    return [frontend.process(moved(stereo_pair(), k)) for k in range(count)]


def test_every_second_frame_of_a_slow_camera_tells_the_pose_alone(stereo_pair):
    frontend = Frontend(from_mapping(FrontendConfig, {"features.target": 300, "features.mapping_interval": 0.2}))
    frames = frames_of(frontend, stereo_pair, 5)
    assert [f.is_pose_only for f in frames] == [False, True, False, True, False]
    assert frontend.counters.counts["frames_pose_only"] == 2
    between, before = frames[1], frames[0]
    _, now, then = np.intersect1d(between.track_ids, before.track_ids, return_indices=True)
    assert len(now) == len(between) > 60
    assert (between.source == FeatureSource.PREDICTED).all()
    np.testing.assert_allclose(between.sigma_depth, 0.25 * between.depth, rtol=1e-5)
    np.testing.assert_allclose(between.depth[now], before.depth[then], rtol=0.1)  # along the wall


@pytest.mark.parametrize("changed", [{"features.mapping_interval": 0.0}, {"features.tracking": "never"}])
def test_all_frames_map_where_that_is_asked_for(stereo_pair, changed):
    frontend = Frontend(from_mapping(FrontendConfig, {"features.target": 300, **changed}))
    assert not any(f.is_pose_only for f in frames_of(frontend, stereo_pair, 3))


def test_tags_are_not_searched_for_in_frames_that_tell_the_pose_alone(stereo_pair, monkeypatch):
    wanted = {"features.mapping_interval": 0.2, "tags.dictionary": "apriltag_36h11"}
    stage, searched = FeatureStage(from_mapping(FrontendConfig, wanted), FrameTree()), []
    monkeypatch.setattr(TagFeatures, "of_pair", lambda _, images, *others: searched.append(images.stamp_ns) or [])
    monkeypatch.setattr(TagFeatures, "with_tags", lambda _, features, tags: features)
    for k in range(4):
        stage.add_images(moved(stereo_pair(), k))
    features = [stage.measure(frame) for frame in stage.extracted()]
    assert [f.is_pose_only for f in features] == [False, True, False, True]
    assert searched == [f.stamp_ns for f in features if not f.is_pose_only]
