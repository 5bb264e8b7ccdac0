# SPDX-License-Identifier: Apache-2.0
"""Fusing of observations against sets of them, as one would write it down."""

from __future__ import annotations

import numpy as np
import pytest

from sjsam_node.graph.fusion import Fusion

SIZES = (30, 20, 40, 30, 25)


def fused() -> Fusion:
    fusion = Fusion()
    for record, size in enumerate(SIZES):
        fusion.append(size, record)
    return fusion


def random_pairs(rng: np.random.Generator) -> np.ndarray:
    """Pairs of observations, of landmarks that repeat in every submap, some of them wrong."""
    pairs = rng.integers(0, sum(SIZES), (400, 2))
    alike = pairs[:, 0] % 13 == pairs[:, 1] % 13
    return np.asarray(pairs[alike | (rng.random(len(pairs)) < 0.1)])


def as_sets(pairs: np.ndarray) -> tuple[np.ndarray, int]:
    record_of = np.repeat(np.arange(len(SIZES)), SIZES)
    landmarks = [{i} for i in range(sum(SIZES))]
    count = 0
    for a, b in pairs.tolist():
        one, other = landmarks[a], landmarks[b]
        if one is not other and not {record_of[i] for i in one} & {record_of[i] for i in other}:
            one |= other
            for i in other:
                landmarks[i] = one
        count += landmarks[a] is landmarks[b]
    return np.array([min(s) for s in landmarks]), count


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_are_those_of_plain_sets(seed: int) -> None:
    pairs = random_pairs(np.random.default_rng(seed))
    expected, count = as_sets(pairs)
    fusion = fused()
    assert fusion.unite(pairs) == count
    assert np.array_equal(fusion.landmark_of, expected)
    sizes = np.bincount(expected, minlength=len(expected))
    assert np.array_equal(fusion.is_shared(), sizes[expected] > 1)
    assert len(np.unique(expected)) < len(expected) - 20


def test_a_copy_stays_as_it_was(rng: np.random.Generator) -> None:
    fusion, pairs = fused(), random_pairs(rng)
    fusion.unite(pairs[:40])
    before = fusion.copy()
    kept = before.landmark_of.copy()
    fusion.unite(pairs[40:])
    assert not np.array_equal(fusion.landmark_of, kept)
    assert np.array_equal(before.landmark_of, kept)
    before.unite(pairs[40:])
    assert np.array_equal(before.landmark_of, fusion.landmark_of)
    before.separate()
    assert not before.is_shared().any()
