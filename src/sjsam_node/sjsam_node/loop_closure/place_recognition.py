# SPDX-License-Identifier: Apache-2.0
"""Finds earlier submaps that look like a new one, however far the estimate has drifted.

A vocabulary tree (Nister and Stewenius 2006) quantises landmark descriptors to words; an inverted file with tf-idf
weights ranks the submaps that share words. The tree is grown once, from the first submaps, by a deterministic
hierarchical k-means, so that the same submaps always give the same ranking. Geometry decides afterwards
(:mod:`sjsam_node.loop_closure.verification`).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.linear_algebra.sparse_cholesky import IntArray

Descriptors = npt.NDArray[np.float32]

_BRANCHING = 10
"""Children of a node of the vocabulary tree."""
_PROPOSALS_PER_CANDIDATE = 5
"""Times as many places as are checked that the vocabulary proposes."""
_DEPTH = 3
"""Levels of the vocabulary tree."""


@dataclass(frozen=True)
class PlaceRecognitionConfig(Config):
    """The vocabulary and how many places are looked at."""

    training_descriptors: int = 1500
    """Descriptors from which the tree is grown."""
    candidates: int = parameter(6, "best ranked submaps that are proposed", minimum=1)


class VocabularyTree:
    """Hierarchical k-means over unit descriptors; a word is a leaf."""

    def __init__(self, descriptors: Descriptors) -> None:
        self.branching = _BRANCHING
        self._centres: dict[int, Descriptors] = {}
        self._grow(0, np.asarray(descriptors, dtype=np.float32), 0)

    def _grow(self, node: int, members: Descriptors, level: int) -> None:
        if level == _DEPTH or len(members) < 2 * self.branching:
            return
        centres = _kmeans(members, self.branching)
        nearest = np.argmax(members @ centres.T, axis=1)
        self._centres[node] = centres
        for child in range(self.branching):
            self._grow(node * self.branching + child + 1, members[nearest == child], level + 1)

    def words(self, descriptors: Descriptors) -> IntArray:
        """Word of each descriptor (n, d), shape (n,)."""
        node = np.zeros(len(descriptors), dtype=np.int64)
        for _ in range(_DEPTH):
            for parent in np.unique(node):
                centres = self._centres.get(int(parent))
                if centres is not None:
                    here = np.nonzero(node == parent)[0]
                    node[here] = parent * self.branching + np.argmax(descriptors[here] @ centres.T, axis=1) + 1
        return node


def _kmeans(members: Descriptors, count: int, iterations: int = 8) -> Descriptors:
    """Spherical k-means from evenly spaced members, so that nothing is drawn at random."""
    centres = members[np.linspace(0, len(members) - 1, count).astype(np.int64)].copy()
    for _ in range(iterations):
        nearest = np.argmax(members @ centres.T, axis=1)
        for k in range(count):
            mean = members[nearest == k].sum(axis=0)
            norm = float(np.linalg.norm(mean))
            if norm > 0.0:
                centres[k] = mean / norm
    return centres


@dataclass
class PlaceIndex:
    """Inverted file of the submaps seen so far; ``add`` and ``query`` in any order."""

    config: PlaceRecognitionConfig = field(default_factory=PlaceRecognitionConfig)
    _tree: VocabularyTree | None = None
    _waiting: list[tuple[int, Descriptors]] = field(default_factory=list)
    _postings: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    _sizes: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _posted: int = 0
    _descriptors: dict[int, Descriptors] = field(default_factory=dict)

    def add(self, place: int, descriptors: Descriptors) -> None:
        """Index the descriptors of ``place``; the tree grows as soon as there are enough to grow it from."""
        self._descriptors[place] = descriptors
        self._waiting.append((place, descriptors))
        if self._tree is None:
            if sum(len(d) for _, d in self._waiting) < self.config.training_descriptors:
                return
            self._tree = VocabularyTree(np.concatenate([d for _, d in self._waiting]))
        for waiting, held in self._waiting:
            self._post(waiting, self._tree.words(held))
        self._waiting.clear()

    def move(self, place: int, descriptors: Descriptors) -> None:
        """Go on with the same descriptors of a place in another memory, or on disk."""
        if place in self._descriptors:
            self._descriptors[place] = descriptors

    def _post(self, place: int, words: IntArray) -> None:
        missing = max(place + 1 - len(self._sizes), 0)
        self._sizes = np.concatenate([self._sizes, np.ones(missing, dtype=np.int64)])
        self._sizes[place] = max(len(words), 1)
        self._posted += 1
        for word in np.unique(words).tolist():
            self._postings[word].append(place)

    def query(self, descriptors: Descriptors, excluded: set[int]) -> list[int]:
        """The places most similar to ``descriptors``, best first.

        The vocabulary proposes a few times as many as are asked for; the descriptors themselves decide among them.
        """
        if self._tree is None:
            known = [place for place in self._descriptors if place not in excluded]
        else:
            known = self._proposed(self._tree.words(descriptors), excluded)
        direct = {place: likeness(self._descriptors[place], descriptors) for place in known}
        return sorted(known, key=lambda p: (-direct[p], p))[: self.config.candidates]

    def _proposed(self, words: IntArray, excluded: set[int]) -> list[int]:
        """The places that share most words, best first: rare words weigh more (inverse document frequency)."""
        shared = [self._postings[word] for word in np.unique(words).tolist() if word in self._postings]
        if not shared:
            return []
        lengths = np.array([len(posting) for posting in shared])
        places = np.concatenate([np.asarray(posting, dtype=np.int64) for posting in shared])
        idf = np.log(1.0 + self._posted / lengths)
        total = np.bincount(places, weights=np.repeat(idf, lengths), minlength=len(self._sizes))
        total[[place for place in excluded if place < len(total)]] = 0.0
        found = np.nonzero(total)[0]
        score = total[found] / np.sqrt(self._sizes[found])
        ranked = found[np.argsort(-score, kind="stable")]
        return [int(place) for place in ranked[: _PROPOSALS_PER_CANDIDATE * self.config.candidates]]


def likeness(first: Descriptors, second: Descriptors) -> float:
    """Likeness of two places: how well the second one's descriptors find a counterpart in the first."""
    if not len(first) or not len(second):
        return 0.0
    return float(np.clip((first @ second.T).max(axis=0) - 0.5, 0.0, None).sum())
