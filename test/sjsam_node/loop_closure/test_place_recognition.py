# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from submap_world import unit

from sjsam_node.loop_closure.place_recognition import PlaceIndex, PlaceRecognitionConfig, VocabularyTree


def places(count: int, rng: np.random.Generator, n: int = 50) -> list[np.ndarray]:
    return [unit(rng.normal(size=(n, 128))).astype(np.float32) for _ in range(count)]


def seen_again(place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Half of the landmarks, noisy, among as many strangers."""
    half = len(place) // 2
    noisy = unit(place[:half] + 0.04 * rng.normal(size=(half, 128)))
    return np.concatenate([noisy, unit(rng.normal(size=(half, 128)))]).astype(np.float32)


@pytest.mark.parametrize("training", [200, 10_000_000], ids=["vocabulary", "no vocabulary yet"])
def test_a_place_seen_again_is_ranked_first(training: int, rng: np.random.Generator) -> None:
    index = PlaceIndex(PlaceRecognitionConfig(training_descriptors=training))
    known = places(40, rng)
    for k, descriptors in enumerate(known):
        index.add(k, descriptors)
    firsts = [index.query(seen_again(known[k], rng), set())[:3] for k in range(40)]
    assert sum(k in ranked for k, ranked in enumerate(firsts)) >= 38


def test_excluded_places_are_not_returned_and_the_number_is_bounded(rng: np.random.Generator) -> None:
    index = PlaceIndex(PlaceRecognitionConfig(training_descriptors=100, candidates=4))
    known = places(20, rng)
    for k, descriptors in enumerate(known):
        index.add(k, descriptors)
    ranked = index.query(known[3], {3})
    assert 3 not in ranked
    assert len(ranked) <= 4


def test_the_same_descriptors_give_the_same_words(rng: np.random.Generator) -> None:
    descriptors = np.concatenate(places(10, rng))
    first, second = VocabularyTree(descriptors), VocabularyTree(descriptors)
    assert np.array_equal(first.words(descriptors), second.words(descriptors))
    assert len(np.unique(first.words(descriptors))) > 50


def test_an_empty_index_knows_nothing(rng: np.random.Generator) -> None:
    assert PlaceIndex().query(places(1, rng)[0], set()) == []
