# SPDX-License-Identifier: Apache-2.0
"""Place recognition across maps and comparison of submaps, as tasks.

The index of descriptors is sharded: each map is a shard that a worker holds. Every submap is looked up in the shards of
the other maps before its own; the best of what all propose is compared, landmark by landmark, where the two maps are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, groupby
from typing import Any

import numpy as np

from sjsam_node.graph.links import Status
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.loop_closure.association import PointSet
from sjsam_node.loop_closure.detector import Comparison, Found, compared
from sjsam_node.loop_closure.place_recognition import Descriptors, PlaceIndex, PlaceRecognitionConfig, likeness
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.loop_closure.verification import ALIKE_CANDIDATES, ClosureConfig, Verifier
from sjsam_node.regions.tasks import Tasks
from slam_core.linear_algebra.block_pattern import IntArray

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
    """A submap of an earlier map that looks like one of a later map, and how much."""

    first: int
    second: int
    likeness: float


@dataclass(frozen=True, eq=False)
class Alike:
    """Two submaps of different maps that geometry supports as one place, by looks alone."""

    ends: tuple[int, int]
    found: Found
    log10_false_alarms: float


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
    earlier: dict[int, PointSet], later: dict[int, PointSet], wanted: list[Comparison], config: ClosureConfig
) -> list[Found]:
    """Comparisons of submaps of two maps."""
    verifier = Verifier(config)
    return [compared(verifier, earlier[w.first], later[w.second], w) for w in wanted]


def _alike(
    earlier: dict[int, PointSet], later: dict[int, PointSet], pairs: list[tuple[int, int]], config: ClosureConfig
) -> list[Alike]:
    """Those of some pairs of submaps that geometry supports, without any prior."""
    verifier, out = Verifier(config), []
    for first, second in pairs:
        a, b = earlier[first], later[second]
        found, status = verifier.verify_alike(a, b, None, 0.0, first, second) if verifier.is_alike(a, b) else _NOTHING
        if found is not None:
            out.append(Alike((first, second), (found, status), verifier.log10_false_alarms(a, b, found)))
    return out


_NOTHING: Found = (None, Status.UNINFORMATIVE)


# -- the maps of a merge on the workers --------------------------------------------------------------------------------


class AcrossMaps:
    """The submaps of several maps in one graph, held where tasks compare them.

    Parameters
    ----------
    graph
        All submaps.
    source
        The map (records,) that each is of.
    redundant
        Mask (records,) of those that show nothing new.
    config
        Of closures.
    tasks
        Where they run.
    """

    def __init__(
        self, graph: MapGraph, source: IntArray, redundant: np.ndarray, config: ClosureConfig, tasks: Tasks
    ) -> None:
        self._source, self._config, self._tasks = source.tolist(), config, tasks
        self._count = max(self._source) + 1
        own: list[list[int]] = [[] for _ in range(self._count)]
        for record, number in enumerate(self._source):
            own[number].append(record)
        self._shards = [
            tasks.hold(_shard(graph, [i for i in records if not redundant[i]], config.places)) for records in own
        ]
        self._sets = [tasks.hold({i: _copied(at_start(graph.records[i])) for i in records}) for records in own]

    def alike(self) -> list[Alike]:
        """Submaps of different maps that are one place by their looks, the surest first."""
        pairs = list(combinations(range(self._count), 2))
        handles = [self._tasks.submit(_proposed, self._shards[a], self._shards[b]) for a, b in pairs]
        best: dict[int, list[Proposal]] = {}
        for proposals in self._tasks.gather(handles):
            for one in proposals:
                best.setdefault(one.second, []).append(one)
        wanted = [
            (one.first, second)
            for second, proposals in best.items()
            for one in sorted(proposals, key=lambda p: (-p.likeness, p.first))[:ALIKE_CANDIDATES]
        ]
        batches = self._batches(wanted)
        found = self._run(_alike, [(maps, [wanted[i] for i in batch]) for maps, batch in batches])
        every = [one for part in found for one in part]
        return sorted(every, key=lambda one: (one.log10_false_alarms, one.ends))

    def compare(self, wanted: Sequence[Comparison]) -> list[Found]:
        """Comparisons, as :attr:`LoopDetector.compare` asks for them."""
        batches = self._batches([(w.first, w.second) for w in wanted])
        results = self._run(_compared, [(maps, [wanted[i] for i in batch]) for maps, batch in batches])
        out: list[Found] = [_NOTHING] * len(wanted)
        for (_, batch), found in zip(batches, results, strict=True):
            for i, one in zip(batch, found, strict=True):
                out[i] = one
        return out

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


def _shard(graph: MapGraph, records: list[int], config: PlaceRecognitionConfig) -> Shard:
    return Shard(tuple(records), tuple(np.array(graph.records[i].submap.descriptors) for i in records), config)


def _copied(points: PointSet) -> PointSet:
    """The same in memory: what a map keeps on disk is read once, and sent."""
    return PointSet(np.array(points.points), np.array(points.covariance), np.array(points.descriptors))
