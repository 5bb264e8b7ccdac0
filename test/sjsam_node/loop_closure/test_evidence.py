# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import binom
from submap_world import two_views, unit

from sjsam_node.graph.links import Prior
from sjsam_node.loop_closure.association import Alignment, AssociationConfig, PointSet, align
from sjsam_node.loop_closure.evidence import ClosureEvidence, evidence_of
from sjsam_node.loop_closure.verification import Verifier

CONFIG = AssociationConfig()


def test_the_number_of_false_alarms_is_that_of_all_triples_times_the_binomial_tail() -> None:
    triples = len(list(combinations(range(30), 3)))
    for agreeing in (4, 7, 20, 30):
        expected = np.log10(triples * binom.sf(agreeing - 4, 27, 0.02))
        assert ClosureEvidence(30, agreeing, 0.02).log10_false_alarms == pytest.approx(expected, abs=1e-9)


def test_three_pairs_agree_with_an_alignment_of_their_own_and_say_nothing() -> None:
    assert ClosureEvidence(30, 3, 0.001).log10_false_alarms > 0.0
    assert ClosureEvidence(2, 2, 0.001).log10_false_alarms >= 0.0
    assert ClosureEvidence(0, 0, 1.0).log10_false_alarms >= 0.0


def test_more_agreement_fewer_pairs_and_smaller_chance_are_better_evidence() -> None:
    base = ClosureEvidence(40, 12, 0.01).log10_false_alarms
    assert ClosureEvidence(40, 13, 0.01).log10_false_alarms < base
    assert ClosureEvidence(60, 12, 0.01).log10_false_alarms > base
    assert ClosureEvidence(40, 12, 0.05).log10_false_alarms > base


def test_pairs_of_one_place_are_evident_and_pairs_at_random_are_none(rng: np.random.Generator) -> None:
    first, second, T, truth = two_views(rng, 40)
    found = align(first, second, truth, Prior(T, 1e2 * np.eye(6)), CONFIG)
    shuffled = truth.copy()
    shuffled[20:, 1] = np.roll(shuffled[20:, 1], 1)
    good, half = (evidence_of(first, second, pairs, found, CONFIG) for pairs in (truth, shuffled))
    assert good.agreeing > 35
    assert good.log10_false_alarms < -30.0
    assert 15 < half.agreeing < 25
    assert good.log10_false_alarms < half.log10_false_alarms < -6.0
    false = np.stack([truth[:, 0], np.roll(truth[:, 1], 3)], axis=1)
    assert evidence_of(first, second, false, found, CONFIG).log10_false_alarms > 0.0


def test_many_features_in_one_spot_count_once(rng: np.random.Generator) -> None:
    first, second, T, truth = two_views(rng, 20)
    one = np.repeat(truth[:1], 20, axis=0)
    found = align(first, second, truth, Prior(T, 1e2 * np.eye(6)), CONFIG)
    assert evidence_of(first, second, one, found, CONFIG).agreeing == 1


def test_chance_does_not_make_an_alignment_of_two_places_evident() -> None:
    """Fewer than one false alarm in a comparison is rare, and the bound of a single closure is never reached."""
    alarms, verifier = [], Verifier()
    for seed in range(200):
        rng = np.random.default_rng(seed)
        sets = []
        for _ in range(2):
            points = rng.uniform(-3.0, 3.0, (60, 3)) * [1.0, 1.0, 0.4]
            looks = unit(rng.normal(size=(60, 8))).astype(np.float32)  # so few elements that most look alike
            sets.append(PointSet(points, 0.03**2 * np.eye(180), looks))
        found = verifier.by_looks(*sets, (seed,))
        alarms.append(0.0 if found is None else verifier.log10_false_alarms(*sets, found))
    assert np.mean(np.array(alarms) < 0.0) < 0.05
    assert min(alarms) > -3.0


def test_submaps_too_sure_of_themselves_agree_within_wider_gates(rng: np.random.Generator) -> None:
    first, second, T, truth = two_views(rng, 40)
    sure = [replace(s, covariance=s.covariance / 9.0) for s in (first, second)]
    found = align(*sure, truth, Prior(T, 1e2 * np.eye(6)), replace(CONFIG, position_noise=0.0))
    assert evidence_of(*sure, truth, found, replace(CONFIG, position_noise=0.0)).agreeing > 35
    far = Alignment(truth, found.T, found.covariance, 0.0, 0)
    moved = replace(first, points=first.points + np.array([3.0, 0.0, 0.0]))
    assert evidence_of(moved, second, truth, far, CONFIG).agreeing < 20


def test_where_many_landmarks_lie_in_a_gate_agreement_says_less(rng: np.random.Generator) -> None:
    first, second, T, truth = two_views(rng, 40)
    found = align(first, second, truth, Prior(T, 1e2 * np.eye(6)), CONFIG)
    sparse = evidence_of(first, second, truth, found, CONFIG)
    assert sparse.chance == pytest.approx(1.0 / 40.0, rel=0.1)
    spread = PointSet(first.points, 100.0 * first.covariance, first.descriptors)
    assert evidence_of(spread, second, truth, found, CONFIG).chance > 1.8 * sparse.chance
