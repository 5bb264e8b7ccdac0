# SPDX-License-Identifier: Apache-2.0
"""Place recognition across maps and comparison of submaps, as tasks.

The index of descriptors is sharded: each map is a shard that a worker holds. Every submap is looked up in the shards of
the maps before its own; the best of what all propose are aligned, landmark by landmark, where the two maps are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, groupby
from typing import Any

import numpy as np

from sjsam_node.loop_closure.association import Alignment, PointSet
from sjsam_node.loop_closure.detector import Found, RecordPair, compared
from sjsam_node.loop_closure.place_recognition import Descriptors, PlaceIndex, PlaceRecognitionConfig, likeness
from sjsam_node.loop_closure.verification import ALIKE_CANDIDATES, ClosureConfig, Verifier
from sjsam_node.merging.moved import Moved, moved_between
from sjsam_node.merging.union import Union
from sjsam_node.regions.tasks import Tasks
from slam_core.types import Submap

_BATCH = 8
"""Pairs of submaps that one task compares, at most."""


@dataclass(frozen=True, eq=False)
class Shard:
    """One map's submaps that show something new: their numbers and descriptors, and how places are ranked."""

    records: tuple[int, ...]
    descriptors: tuple[Descriptors, ...]
    config: PlaceRecognitionConfig

    @cached_property
    def index(self) -> PlaceIndex:
        """The index of these submaps."""
        index = PlaceIndex(self.config)
        for record, descriptors in zip(self.records, self.descriptors, strict=True):
            index.add(record, descriptors)
        return index


@dataclass(frozen=True, eq=False)
class Proposal:
    """Submaps of two maps that look alike, and how much."""

    first: int
    second: int
    likeness: float


# -- tasks: pure functions ---------------------------------------------------------------------------------------------


def _proposed(earlier: Shard, later: Shard) -> list[Proposal]:
    """The submaps of an earlier map that look most like each one of a later map."""
    out = []
    held = dict(zip(earlier.records, earlier.descriptors, strict=True))
    for record, descriptors in zip(later.records, later.descriptors, strict=True):
        for place in earlier.index.query(descriptors, set()):
            out.append(Proposal(place, record, likeness(held[place], descriptors)))
    return out


def _compared(
    earlier: dict[int, PointSet], later: dict[int, PointSet], wanted: list[RecordPair], config: ClosureConfig
) -> list[Found]:
    """Comparisons of submaps of two maps."""
    verifier = Verifier(config)
    return [compared(verifier, earlier[w.first], later[w.second], w) for w in wanted]


def _looked_at(
    earlier: dict[int, PointSet], later: dict[int, PointSet], pairs: list[tuple[int, int]], config: ClosureConfig
) -> list[Alignment | None]:
    """Alignments by looks of some pairs of submaps of two maps."""
    verifier = Verifier(config)
    return [verifier.by_looks(earlier[first], later[second], (first, second)) for first, second in pairs]


def _moved(
    earlier: dict[int, PointSet],
    later: dict[int, PointSet],
    places: list[tuple[tuple[int, int], Alignment | None]],
    config: ClosureConfig,
) -> list[Moved | None]:
    """Things that stood elsewhere, between some pairs of submaps of two maps, which align so."""
    verifier = Verifier(config)
    return [moved_between(verifier, earlier[pair[0]], later[pair[1]], place, pair) for pair, place in places]


# -- the maps of a merge on the workers --------------------------------------------------------------------------------


class AcrossMaps:
    """The submaps of several maps, held where tasks compare them; numbered in the order in which they are joined.

    Parameters
    ----------
    union
        All submaps.
    config
        Of closures.
    tasks
        Where they run.
    """

    def __init__(self, union: Union, config: ClosureConfig, tasks: Tasks) -> None:
        self._source, self._config, self._tasks = union.source, config, tasks
        self._submaps, self._count = union.submaps, len(union.names)
        own: list[list[int]] = [[] for _ in range(self._count)]
        for number, source in enumerate(union.source):
            own[source].append(number)
        self._shards = [tasks.hold(self._shard(numbers)) for numbers in own]
        self._sets = [tasks.hold({i: _points(union.submaps[i]) for i in numbers}) for numbers in own]

    def _shard(self, numbers: list[int]) -> Shard:
        return Shard(
            tuple(numbers), tuple(np.array(self._submaps[i].descriptors) for i in numbers), self._config.places
        )

    @cached_property
    def looks(self) -> dict[tuple[int, int], Alignment | None]:
        """Alignments by looks of the submaps of different maps that look most alike, as ``Verifier.looks``."""
        pairs = list(combinations(range(self._count), 2))
        handles = [self._tasks.submit(_proposed, self._shards[a], self._shards[b]) for a, b in pairs]
        best: dict[int, list[Proposal]] = {}
        for proposals in self._tasks.gather(handles):
            for one in proposals:
                best.setdefault(max(one.first, one.second), []).append(one)
        wanted = [
            (min(one.first, one.second), later)
            for later, proposals in sorted(best.items())
            for one in sorted(proposals, key=lambda p: (-p.likeness, p.first, p.second))[:ALIKE_CANDIDATES]
        ]
        wanted = list(dict.fromkeys(wanted))
        batches = self._batches(wanted)
        results = self._run(_looked_at, [(maps, [wanted[i] for i in batch]) for maps, batch in batches])
        places = [i for _, batch in batches for i in batch]
        found = [one for part in results for one in part]
        return {wanted[i]: one for i, one in zip(places, found, strict=True)}

    def moved(self) -> list[Moved]:
        """Things of earlier submaps that later ones show elsewhere, between submaps that look alike."""
        pairs = list(self.looks)
        batches = self._batches(pairs)
        work = [(maps, [(pairs[i], self.looks[pairs[i]]) for i in batch]) for maps, batch in batches]
        places = [i for _, batch in batches for i in batch]
        found = [one for part in self._run(_moved, work) for one in part]
        ordered = [one for _, one in sorted(zip(places, found, strict=True), key=lambda pair: pair[0])]
        return [one for one in ordered if one is not None]

    def compare(self, wanted: Sequence[RecordPair]) -> list[Found]:
        """Comparisons, as :attr:`LoopDetector.compare` asks for them."""
        batches = self._batches([(w.first, w.second) for w in wanted])
        results = self._run(_compared, [(maps, [wanted[i] for i in batch]) for maps, batch in batches])
        places = [i for _, batch in batches for i in batch]
        found = [one for part in results for one in part]
        return [found[k] for k in np.argsort(np.array(places, dtype=np.int64))]

    def _batches(self, pairs: Sequence[tuple[int, int]]) -> list[tuple[tuple[int, int], list[int]]]:
        """Pairs of the same two maps together, at most :data:`_BATCH`: the maps, and places in ``pairs``."""
        maps = [(self._source[first], self._source[second]) for first, second in pairs]
        ordered = sorted(range(len(pairs)), key=lambda i: (maps[i], i))
        out = []
        for key, group in groupby(ordered, key=lambda i: maps[i]):
            places = list(group)
            out += [(key, places[k : k + _BATCH]) for k in range(0, len(places), _BATCH)]
        return out

    def _run(self, function: Any, batches: list[tuple[tuple[int, int], list[Any]]]) -> list[Any]:
        handles = [self._tasks.submit(function, self._sets[a], self._sets[b], own, self._config)
                   for (a, b), own in batches]  # fmt: skip
        return self._tasks.gather(handles)


def _points(submap: Submap) -> PointSet:
    """Landmarks in the frame of the start, in memory: what a map keeps on disk is read once, and sent."""
    covariance = np.array(submap.covariance[6:, 6:])
    return PointSet(np.array(submap.landmarks), covariance, np.array(submap.descriptors))
