# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags in the filter: landmarks with names, correlated with all else, let go where they are moved."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.slam import EkfSlam
from feature_world import CAMERA, T_RIG_OPTICAL, PointWorld
from slam_core.geometry import FloatArray, invert_transform, make_transform, rotation_from_euler, transform_points
from slam_core.tags import corner_ids, square, whole_tags
from slam_core.types import Features, FeatureSource, Submap

WALL = make_transform(rotation_from_euler(-np.pi / 2, 0.0, np.pi / 2), np.array([4.0, 0.4, 0.2]))
"""T_world_tag of a tag that faces the rig."""
SIZE, DT_NS = 0.2, 100_000_000


def poses(n: int) -> list[FloatArray]:
    return [make_transform(rotation_from_euler(0.003 * k), np.array([0.02 * k, 0.01 * k, 0.0])) for k in range(n)]


def with_tag(features: Features, T_world_rig: FloatArray, T_tag: FloatArray, rng: np.random.Generator) -> Features:
    corners = transform_points(invert_transform(T_world_rig @ T_RIG_OPTICAL) @ T_tag, square(SIZE))
    uv = CAMERA.project(corners) + 0.4 * rng.normal(size=(4, 2))
    sigma = 0.01 * corners[:, 2]
    depth = corners[:, 2] + sigma * rng.normal(size=4)
    tag = Features(
        features.stamp_ns, CAMERA.unproject(uv, depth).astype(np.float32), uv.astype(np.float32),
        depth.astype(np.float32), np.full((4, 2), 0.4, np.float32), sigma.astype(np.float32), np.ones(4, np.float32),
        np.full(4, FeatureSource.TAG, np.uint8), np.zeros((4, features.descriptors.shape[1]), np.float32), CAMERA,
        track_ids=corner_ids([7]).astype(np.int32),
    )  # fmt: skip
    return features.joined(tag)


def mapped(seed: int, tag_at: list[FloatArray | None]) -> tuple[EkfSlam, tuple[Submap, ...], list[FloatArray]]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([2.0, -3.0, -2.0], [8.0, 3.0, 2.0], (250, 3))
    looks = rng.normal(size=(250, 64))
    world = PointWorld(points, (looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype(np.float32))
    slam, way = EkfSlam(EkfSlamConfig()), poses(len(tag_at))
    submaps: list[Submap] = []
    for k, (T, T_tag) in enumerate(zip(way, tag_at, strict=True)):
        features, _ = world.features(T, (k + 1) * DT_NS, rng)
        result = slam.process(features if T_tag is None else with_tag(features, T, T_tag, rng))
        submaps += result.submaps
    return slam, (*submaps, *slam.finish()), way


def test_a_submap_has_the_tags_it_saw_where_they_are() -> None:
    squares = []
    for seed in range(8):
        _, submaps, way = mapped(seed, [WALL] * 14)
        submap = submaps[0]
        rows = whole_tags(submap.landmark_ids)[7]
        true = transform_points(invert_transform(way[0]) @ WALL, square(SIZE))
        error = (submap.landmarks[rows] - true).ravel()
        at = (6 + 3 * rows[:, None] + np.arange(3)).ravel()
        P = submap.covariance[np.ix_(at, at)]
        squares.append(error @ np.linalg.solve(P, error) / 12)
        assert submap.sightings[rows].min() > 5
        cross = submap.covariance[:6][:, at]
        assert np.abs(cross).max() > 0.0  # the tag's place and the end pose err together
        np.linalg.cholesky(submap.covariance)
    assert 0.5 < np.mean(squares) < 1.7


def test_a_tag_that_moves_begins_anew_and_is_counted() -> None:
    moved = WALL.copy()
    moved[:3, 3] += [0.0, -0.5, 0.3]
    slam, submaps, way = mapped(3, [WALL] * 7 + [moved] * 12)
    assert slam.counters.counts["tags_moved"] == 1
    last = submaps[-1]
    start = next(k for k in range(len(way)) if (k + 1) * DT_NS == last.start_stamp_ns)
    rows = whole_tags(last.landmark_ids)[7]
    true = transform_points(invert_transform(way[start]) @ moved, square(SIZE))
    assert np.linalg.norm(last.landmarks[rows] - true, axis=1).max() < 0.15


def test_a_frame_without_tags_is_what_it_was() -> None:
    _, plain, _ = mapped(1, [None] * 12)
    assert all((s.landmark_ids >= 0).all() for s in plain)


def test_a_tag_with_a_corner_that_is_no_number_is_left_out() -> None:
    rng = np.random.default_rng(0)
    slam, way = EkfSlam(EkfSlamConfig()), poses(10)
    points = rng.uniform([2.0, -3.0, -2.0], [8.0, 3.0, 2.0], (250, 3))
    looks = rng.normal(size=(250, 64)).astype(np.float32)
    world = PointWorld(points, looks / np.linalg.norm(looks, axis=1, keepdims=True))
    for k, T in enumerate(way):
        features = with_tag(world.features(T, (k + 1) * DT_NS, rng)[0], T, WALL, rng)
        features.depth[-1] = np.nan
        slam.process(features)
    assert slam.counters.counts.get("tags_measured", 0) == 0
    assert not whole_tags(slam.finish()[0].landmark_ids)
