# SPDX-License-Identifier: Apache-2.0
"""Fusing of observations against sets of them, as one would write it down."""

from __future__ import annotations

import numpy as np
import pytest

from sjsam_node.graph.landmark_sets import LandmarkSets

SIZES = (30, 20, 40, 30, 25)


def alone() -> LandmarkSets:
    sets = LandmarkSets()
    for record, size in enumerate(SIZES):
        sets = sets.with_submap(size, record)
    return sets


def random_pairs(rng: np.random.Generator) -> np.ndarray:
    """Pairs of observations, of landmarks that repeat in every submap, some of them wrong."""
    pairs = rng.integers(0, sum(SIZES), (400, 2))
    alike = pairs[:, 0] % 13 == pairs[:, 1] % 13
    return np.asarray(pairs[alike | (rng.random(len(pairs)) < 0.1)])


def as_sets(pairs: np.ndarray) -> np.ndarray:
    record_of = np.repeat(np.arange(len(SIZES)), SIZES)
    landmarks = [{i} for i in range(sum(SIZES))]
    for a, b in pairs.tolist():
        one, other = landmarks[a], landmarks[b]
        if one is not other and not {record_of[i] for i in one} & {record_of[i] for i in other}:
            one |= other
            for i in other:
                landmarks[i] = one
    return np.array([min(s) for s in landmarks])


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_are_those_of_plain_sets(seed: int) -> None:
    pairs = random_pairs(np.random.default_rng(seed))
    expected = as_sets(pairs)
    sets = alone().united(pairs)
    assert np.array_equal(sets.landmark_of, expected)
    sizes = np.bincount(expected, minlength=len(expected))
    assert np.array_equal(sets.is_shared, sizes[expected] > 1)
    assert len(np.unique(expected)) < len(expected) - 20


def test_sets_stay_as_they_were_when_others_are_made_of_them(rng: np.random.Generator) -> None:
    pairs = random_pairs(rng)
    before = alone().united(pairs[:40])
    kept = before.landmark_of.copy(), before.following.copy()
    after = before.united(pairs[40:])
    assert not np.array_equal(after.landmark_of, kept[0])
    assert np.array_equal(before.landmark_of, kept[0])
    assert np.array_equal(before.following, kept[1])
    assert np.array_equal(after.landmark_of, alone().united(pairs).landmark_of)
    assert not after.separated().is_shared.any()
