# SPDX-License-Identifier: Apache-2.0
"""Features of several cameras as one frame: whose each is, tracks that stay apart, tags that count once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feature_world import PointWorld
from slam_core.rig_features import MOST_CAMERAS, features_of_rig
from slam_core.tags import corner_ids
from slam_core.types import Features


def some_features(seed: int, frame_id: str, tracks: np.ndarray | None = None) -> Features:
    rng = np.random.default_rng(seed)
    points = rng.uniform([2, -2, -1], [5, 2, 1], (20, 3))
    looks = rng.standard_normal((20, 64))
    features, _ = PointWorld(points, looks / np.linalg.norm(looks, axis=1, keepdims=True)).features(
        np.eye(4), 7, rng, detection=1.0, max_features=10
    )
    tracks = np.arange(1, 11) if tracks is None else tracks
    return replace(features, frame_id=frame_id, track_ids=tracks.astype(np.int32))


def test_each_feature_knows_its_camera_and_none_is_lost() -> None:
    front, back = some_features(1, "front"), some_features(2, "back")
    both = features_of_rig([(0, front), (3, back)])
    assert [(c.frame_id, c.number) for c in both.cameras] == [("front", 0), ("back", 3)]
    np.testing.assert_array_equal(both.seen_by, [0] * 10 + [1] * 10)
    np.testing.assert_array_equal(both.uv, np.concatenate([front.uv, back.uv]))
    assert len(set(both.track_ids.tolist())) == 20
    kept = both.select(np.array([3, 12]))
    assert kept.cameras == both.cameras
    assert kept.seen_by.tolist() == [0, 1]


def test_a_feature_without_a_track_stays_without_one() -> None:
    both = features_of_rig([(0, some_features(1, "a", np.zeros(10))), (1, some_features(2, "b"))])
    assert (both.track_ids[:10] == 0).all()
    assert (both.track_ids[10:] > 0).all()


def test_a_tag_that_two_cameras_see_counts_for_the_first() -> None:
    own = np.concatenate([corner_ids([5]), np.arange(1, 7)])
    other = np.concatenate([corner_ids([5]), corner_ids([6]), [1, 2]])
    both = features_of_rig([(0, some_features(1, "a", own)), (1, some_features(2, "b", other))])
    tags = both.track_ids < 0
    assert sorted(both.track_ids[tags]) == sorted([*corner_ids([5]), *corner_ids([6])])
    assert (both.seen_by[np.isin(both.track_ids, corner_ids([5]))] == 0).all()


def test_two_cameras_with_one_frame_are_refused() -> None:
    with pytest.raises(ValueError, match="a frame of its own, got a, a"):
        features_of_rig([(0, some_features(1, "a")), (1, some_features(2, "a"))])


def test_a_blind_camera_takes_part_whatever_the_size_of_its_descriptors() -> None:
    nothing = some_features(1, "a").select(np.zeros(0, np.int64))
    nothing = replace(nothing, descriptors=np.zeros((0, 0), np.float32))
    both = features_of_rig([(0, nothing), (1, some_features(2, "b"))])
    assert len(both) == 10
    assert both.descriptors.shape == (10, 64)
    assert len(both.cameras) == 2


def test_what_cannot_be_one_frame_is_refused() -> None:
    small = some_features(1, "a")
    small = replace(small, descriptors=small.descriptors[:, :32])
    with pytest.raises(ValueError, match=r"sizes \[32, 64\]"):
        features_of_rig([(0, small), (1, some_features(2, "b"))])
    with pytest.raises(ValueError, match="at most 8 cameras"):
        features_of_rig([(MOST_CAMERAS, small)])
    with pytest.raises(ValueError, match="at least one"):
        features_of_rig([])
