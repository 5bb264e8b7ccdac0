# SPDX-License-Identifier: Apache-2.0
"""Association and motion guess against the simulated truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ekf_slam_node.association import association
from ekf_slam_node.association.linking import Linker
from ekf_slam_node.association.motion_guess import guess_motion
from ekf_slam_node.config import FeatureAssociationConfig
from ekf_slam_node.filtering.candidates import Candidates, MotionPrior, innovation_covariance, motion_prior, predict
from ekf_slam_node.filtering.models import Frame, frame_from_features, relative_motion, rig_points
from feature_world import T_RIG_OPTICAL, PointWorld, room
from slam_core.geometry import FloatArray, boxminus


@pytest.fixture
def world(rng: np.random.Generator) -> PointWorld:
    return room(rng, 800)


def view(world: PointWorld, T: FloatArray, rng: np.random.Generator, stamp_ns: int = 0) -> tuple[Frame, np.ndarray]:
    features, index = world.features(T, stamp_ns, rng, max_features=150)
    return frame_from_features(features, np.arange(len(features)), 0.01, 1e-5), index


def candidates_of(frame: Frame) -> Candidates:
    points, covariances = rig_points(frame, T_RIG_OPTICAL)
    return Candidates(points, covariances, frame.descriptors, frame.tracks)


def two_views(
    world: PointWorld, T: FloatArray, rng: np.random.Generator
) -> tuple[Candidates, np.ndarray, Frame, np.ndarray]:
    before, first = view(world, np.eye(4), rng)
    now, second = view(world, T, rng, 1)
    return candidates_of(before), first, now, second


SMALL_STEP = relative_motion(np.array([0.05, 0.02, 0.0, 0.0, 0.01, 0.05]), 1.0)
LARGE_STEP = relative_motion(np.array([0.5, -0.3, 0.1, 0.05, 0.1, 0.6]), 1.0)


@pytest.mark.parametrize("method", ["nearest", "mahalanobis", "jcbb", "ccda"])
def test_small_step_is_associated_rightly(world: PointWorld, rng: np.random.Generator, method: str) -> None:
    candidates, first, now, second = two_views(world, SMALL_STEP, rng)
    prior = motion_prior(np.zeros(6), np.zeros((6, 6)), np.repeat([6.0, 6.0], 3), 0.1)
    config = FeatureAssociationConfig(method=method)
    link = Linker(config, T_RIG_OPTICAL).link(candidates, now, MotionPrior(SMALL_STEP, prior.covariance))
    assert link is not None
    right = first[link.rows] == second[link.columns]
    common = len(np.intersect1d(first, second))
    # The noise of a far depth exceeds any gate in metres that tells neighbours apart: Algorithm 1 finds fewer.
    assert right.mean() > (0.9 if method == "nearest" else 0.99)
    assert right.sum() > (0.3 if method == "nearest" else 0.95) * common


def test_followed_features_are_paired_by_their_tracks_where_descriptors_say_nothing(
    world: PointWorld, rng: np.random.Generator
) -> None:
    candidates, first, now, second = two_views(world, SMALL_STEP, rng)
    wrong = rng.permutation(len(now))[:5]
    tracks = 1 + second
    tracks[wrong] = tracks[np.roll(wrong, 1)]
    blank = np.ones_like(now.descriptors) / np.sqrt(now.descriptors.shape[1])
    candidates = replace(candidates, tracks=1 + first, descriptors=blank[: len(candidates)])
    prior = motion_prior(np.zeros(6), np.zeros((6, 6)), np.repeat([6.0, 6.0], 3), 0.1)
    now = replace(now, tracks=tracks, descriptors=blank)
    link = Linker(FeatureAssociationConfig(), T_RIG_OPTICAL).link(candidates, now, prior)
    assert link is not None
    followed = candidates.tracks[link.rows] == now.tracks[link.columns]
    assert followed.sum() > 0.85 * len(np.intersect1d(first, second))
    assert not np.isin(link.columns[followed], wrong).any()
    error = boxminus(link.T, SMALL_STEP)
    assert error @ np.linalg.solve(link.covariance, error) < 25.0


def test_features_without_a_track_pair_by_their_places(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, first, now, second = two_views(world, SMALL_STEP, rng)
    lost = rng.random(len(now)) < 0.3
    candidates = replace(candidates, tracks=1 + first)
    now = replace(now, tracks=np.where(lost, 0, 1 + second))
    prior = motion_prior(np.zeros(6), np.zeros((6, 6)), np.repeat([6.0, 6.0], 3), 0.1)
    link = Linker(FeatureAssociationConfig(), T_RIG_OPTICAL).link(
        candidates, now, MotionPrior(SMALL_STEP, prior.covariance)
    )
    assert link is not None
    again = lost[link.columns]
    assert (first[link.rows] == second[link.columns])[again].mean() > 0.95
    assert again.sum() > 0.8 * np.isin(second[lost], first).sum()


def test_descriptors_are_needed_where_the_prediction_is_vague(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, first, now, second = two_views(world, SMALL_STEP, rng)
    vague = np.diag(np.repeat([0.05, 0.03], 3) ** 2)
    shares = []
    for threshold in (0.75, -1.0):
        config = FeatureAssociationConfig(descriptor_threshold=threshold, descriptor_weight=0.0)
        rows, columns = association.associate_mahalanobis(candidates, now, np.eye(4), vague, T_RIG_OPTICAL, config)
        shares.append(np.mean(first[rows] == second[columns]))
    assert shares[0] > 0.99
    assert shares[1] < 0.8


def test_gated_costs_are_those_of_equation_4_8(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, _, now, _ = two_views(world, SMALL_STEP, rng)
    prior = np.diag(np.repeat([0.02, 0.01], 3) ** 2)
    seen = predict(candidates, SMALL_STEP, T_RIG_OPTICAL, now)
    S = innovation_covariance(seen, candidates, prior)
    similarity = candidates.descriptors.astype(np.float64) @ now.descriptors.astype(np.float64).T
    costs = np.full(similarity.shape, np.inf)
    visible = seen.in_image(now.camera, margin_px=-50.0)
    rows, columns, values = association._gated_pairs(
        now.z, now.variance, now.descriptors, seen.z, S, visible, candidates.descriptors, -1.0, 16.0, 3.0
    )
    assert len(rows) > 100
    assert np.array_equal(np.lexsort((columns, rows)), np.arange(len(rows)))
    costs[rows, columns] = values
    for i in np.flatnonzero(visible)[:40]:
        for j in range(len(now)):
            joint = S[i] + np.diag(now.variance[j])
            innovation = now.z[j] - seen.z[i]
            nis = innovation @ np.linalg.solve(joint, innovation)
            expected = (
                nis + np.linalg.slogdet(joint)[1] + 3.0 * (1.0 - float(similarity[i, j])) if nis < 16.0 else np.inf
            )
            assert costs[i, j] == pytest.approx(expected, rel=1e-9)


def test_there_is_room_for_every_pair(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, _, now, _ = two_views(world, SMALL_STEP, rng)
    seen = predict(candidates, SMALL_STEP, T_RIG_OPTICAL, now)
    S = np.tile(1e8 * np.eye(3), (len(candidates), 1, 1))
    pairs, everywhere = len(candidates) * len(now), np.ones(len(candidates), bool)
    rows, columns, values = association._gated_pairs(
        now.z, now.variance, now.descriptors, seen.z, S, everywhere, candidates.descriptors, -2.0, 1e9, 0.0
    )
    assert len(rows) == pairs > association._ROOM
    np.testing.assert_array_equal(rows * len(now) + columns, np.arange(pairs))
    assert np.isfinite(values).all()


def test_pairs_are_one_to_one_and_the_cheapest_wins() -> None:
    costs = np.array([[1.0, 0.5, np.inf], [0.2, 0.4, np.inf], [np.inf, np.inf, np.inf]])
    at = np.nonzero(np.isfinite(costs))
    rows, columns = association.pair_up(*at, costs[at], costs.shape)
    assert dict(zip(rows.tolist(), columns.tolist(), strict=True)) == {1: 0, 0: 1}


@pytest.mark.parametrize("wrong_share", [0.0, 0.4])
def test_motion_guess_finds_a_step_that_no_prediction_expects(
    world: PointWorld, rng: np.random.Generator, wrong_share: float
) -> None:
    candidates, first, now, second = two_views(world, LARGE_STEP, rng)
    _, rows, columns = np.intersect1d(first, second, return_indices=True)
    wrong = rng.random(len(rows)) < wrong_share
    columns[wrong] = rng.permutation(columns[wrong])
    really_wrong = first[rows] != second[columns]
    guess = guess_motion(candidates.select(rows), now.select(columns), T_RIG_OPTICAL, rng, 200, 16.27)
    assert guess is not None
    error = boxminus(LARGE_STEP, guess.T)
    assert error @ np.linalg.solve(guess.covariance, error) < 25.0
    assert not (guess.inliers & really_wrong).any()
    assert guess.inliers.sum() > 0.95 * (~really_wrong).sum()


def test_excess_tells_how_much_noisier_the_features_are(world: PointWorld, rng: np.random.Generator) -> None:
    before, first = view(world, np.eye(4), rng)
    features, second = world.features(SMALL_STEP, 1, rng, max_features=150, noise=3.0)
    now = frame_from_features(features, np.arange(len(features)), 0.01, 1e-5)
    _, rows, columns = np.intersect1d(first, second, return_indices=True)
    guess = guess_motion(candidates_of(before).select(rows), now.select(columns), T_RIG_OPTICAL, rng, 200, 16.27)
    assert guess is not None
    # Nine times the variance now, once before, against twice claimed.
    np.testing.assert_allclose(guess.variance_scale, 5.0, rtol=0.5)


def test_large_step_is_linked_and_a_foreign_place_is_not(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, first, now, second = two_views(world, LARGE_STEP, rng)
    prior = MotionPrior(np.eye(4), np.diag(np.repeat([0.02, 0.02], 3) ** 2))
    linker = Linker(FeatureAssociationConfig(), T_RIG_OPTICAL)
    link = linker.link(candidates, now, prior)
    assert link is not None
    assert (first[link.rows] == second[link.columns]).mean() > 0.99
    elsewhere, _ = view(room(np.random.default_rng(99), 800), np.eye(4), rng, 1)
    assert linker.link(candidates, elsewhere, prior) is None


def test_few_features_are_not_linked(world: PointWorld, rng: np.random.Generator) -> None:
    candidates, _, now, _ = two_views(world, SMALL_STEP, rng)
    prior = MotionPrior(SMALL_STEP, 1e-4 * np.eye(6))
    assert Linker(FeatureAssociationConfig(), T_RIG_OPTICAL).link(candidates, now.select(np.arange(5)), prior) is None


@pytest.mark.parametrize("digits", [1, 6], ids=["many are equal", "all differ"])
@pytest.mark.parametrize("shape", [(30, 45), (45, 30), (2, 2), (1, 9), (9, 1), (0, 4)])
def test_mutual_best_pairs_are_those_of_arrays(shape: tuple[int, int], digits: int, rng: np.random.Generator) -> None:
    cosines = np.round(rng.uniform(-1.0, 1.0, shape), digits).astype(np.float32)
    for threshold, ratio in ((0.75, 0.85), (0.6, 1.0), (-2.0, 10.0)):
        rows, columns = association.match_descriptors(cosines).clear(threshold, ratio)
        expected_rows, expected_columns = by_arrays(cosines.astype(np.float64), threshold, ratio)
        np.testing.assert_array_equal(rows, expected_rows)
        np.testing.assert_array_equal(columns, expected_columns)


def by_arrays(cosines: FloatArray, threshold: float, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    if min(cosines.shape) < 2:
        return np.zeros(0), np.zeros(0)
    best, rows = np.argmax(cosines, axis=1), np.arange(len(cosines))
    value, second = cosines[rows, best], np.partition(cosines, -2, axis=1)[:, -2]
    mutual = (np.argmax(cosines, axis=0)[best] == rows) & (value >= threshold)
    rows = rows[mutual & (1.0 - value <= ratio**2 * (1.0 - second))]
    return rows, best[rows]
