# SPDX-License-Identifier: Apache-2.0
"""Old submaps condensed to larger submaps, so that an update relinearises and refactors only what is new.

A *region* is some submaps that lie together, joined to one Gaussian over what the rest of the map shares with them: its
separator, nodes and landmarks. To the joining problem it is one more local map, in the frame of its reference node
(submaps of submaps: Ni and Dellaert 2010). Regions far from the newest submap are joined to larger ones in turn, so
that an update has few of them however large the map is. A region holds wherever later closures move it as a whole. Once
something inside it is linked to the outside, or its separator turns further than the relinearisation threshold, it is
opened: its parts take part in the joining again, down to single submaps where these are what was touched, until it
has been quiet there for a while.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing.region import Active, LocalMaps, Region, join
from slam_core.config import Config, parameter
from slam_core.linear_algebra.sparse_cholesky import IntArray

_FIRM = 4
"""Landmarks in common that tie two submaps together."""
_PARTS = 6
"""Regions that are joined to a larger one, at most."""
_MANY = 10
"""Regions of a component from which on those far away are joined."""


@dataclass(frozen=True)
class RegionConfig(Config):
    """Parameters of condensing: which submaps are joined to larger ones until a closure needs them."""

    size: int = parameter(32, "submaps that are joined to a larger one, at most", minimum=2)
    open: int = 64
    """Submaps of a component that take part in each update one by one, about."""
    quiet: int = 10
    """Submaps that came since one was needed, before it may be joined to others."""
    relinearize: float = 0.002
    """Turn of a region's separator since it was linearised beyond which it is opened (rad), up to ``size`` submaps."""

    def largest_turn(self, region: Region) -> float:
        """The same for a region of any size (rad): along a way turns add up like steps of a random walk."""
        return self.relinearize * float(np.sqrt(max(len(region.records) / self.size, 1.0)))


@dataclass
class Regions:
    """The regions of a map, and when each submap was needed last."""

    local_maps: LocalMaps
    config: RegionConfig = field(default_factory=RegionConfig)
    closed: list[Region] = field(default_factory=list)
    _needed: dict[int, int] = field(default_factory=dict)

    def fitting(self, graph: MapGraph, component: int, parked: IntArray) -> list[Region]:
        """Regions of a component; those that do not hold any more are opened, down to the parts that hold."""
        active, anchor = Active.of(graph, parked), graph.oldest(component).start
        while True:
            own = [r for r in self.closed if graph.component_of[r.reference] == component]
            kept = [r for r in own if r.holds(graph, active, anchor)]
            if len(kept) == len(own):
                return kept
            self.open([r for r in own if r not in kept], len(graph.records))

    def open(self, regions: Sequence[Region], now: int) -> None:
        """Let the parts of some regions take part again."""
        parts = [part for region in regions for part in region.parts]
        self.closed = [*(r for r in self.closed if r not in regions), *parts]
        for region in regions:
            inside = [i for part in region.parts for i in part.records.tolist()]
            self._note(np.setdiff1d(region.records, inside), now)

    def clear(self, now: int) -> None:
        """Let all submaps take part again one by one."""
        while self.closed:
            self.open(self.closed, now)

    def _note(self, records: IntArray, now: int) -> None:
        self._needed.update(dict.fromkeys(records.tolist(), now))

    def close(self, graph: MapGraph, component: int, busy: Sequence[int], parked: IntArray) -> None:
        """Join the submaps that have been quiet for longest to one region, if more than enough are open.

        ``busy`` ones stay. Of many regions those far from the newest submap are joined to one, too.
        """
        active, now = Active.of(graph, parked), len(graph.records)
        is_open = graph.component_of[graph.starts] == component
        is_open[parked] = False
        for region in self.closed:
            is_open[region.records] = False
        if np.count_nonzero(is_open) > self.config.open:
            is_open[list(busy)] = False
            self._close_records(
                graph, component, [i for i in np.nonzero(is_open)[0].tolist() if self._quiet(i, now)], active
            )
        anchor = graph.oldest(component).start
        own = [r for r in self.closed if graph.component_of[r.reference] == component]
        if len(own) > _MANY:
            self._close_regions(graph, component, [r for r in own if r.holds(graph, active, anchor)], active)

    def _quiet(self, record: int, now: int) -> bool:
        return now - self._needed.get(record, record) > self.config.quiet

    def _close_records(self, graph: MapGraph, component: int, quiet: list[int], active: Active) -> None:
        if not quiet:
            return
        first = min(quiet, key=lambda i: (self._needed.get(i, i), i))
        chosen = self._gathered(graph, np.array(quiet), first)
        region = join(graph, chosen, component, self.local_maps, active)
        if region is None:
            self._note(chosen, len(graph.records))
        else:
            self.closed.append(region)

    def _close_regions(self, graph: MapGraph, component: int, regions: list[Region], active: Active) -> None:
        now, here = len(graph.records), graph.poses[graph.starts[-1], :3, 3]
        left = [r for r in regions if self._quiet(int(r.records[0]), now)]
        if not left:
            return
        parts = [max(left, key=lambda r: float(np.linalg.norm(graph.poses[r.reference, :3, 3] - here)))]
        known = parts[0].shown(graph)
        while len(parts) < _PARTS:
            left = [r for r in left if r not in parts]
            nearest = max(left, key=lambda r: len(known & r.shown(graph)), default=None)
            if nearest is None or not known & nearest.shown(graph):
                break
            parts.append(nearest)
            known |= nearest.shown(graph)
        none = np.empty(0, dtype=np.int64)
        region = join(graph, none, component, self.local_maps, active, parts) if len(parts) > 1 else None
        if region is None:
            self._note(parts[0].records[:1], now)
        else:
            self.closed = [*(r for r in self.closed if r not in parts), region]

    def _gathered(self, graph: MapGraph, candidates: IntArray, first: int) -> IntArray:
        """Of the candidates nearest to one, those that hang together with it."""
        middles = graph.middles(candidates)
        distance = np.linalg.norm(middles - graph.middles(np.array([first])), axis=1)
        nearest = np.sort(candidates[np.argsort(distance, kind="stable")[: self.config.size]])
        label = _tied(graph, nearest)
        return np.asarray(nearest[label == label[np.searchsorted(nearest, first)]])


def _tied(graph: MapGraph, records: IntArray) -> IntArray:
    """Label for each of some records: equal for those that hang together by nodes or enough landmarks."""
    observations = np.concatenate([graph.records[i].observations for i in records])
    rows, seen = np.searchsorted(records, graph.record_of[observations]), graph.variable_of[observations]
    B = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, seen)), (len(records), len(graph.points)))
    ends = np.stack([graph.starts[records], graph.ends[records]], axis=1)
    E = scipy.sparse.csr_matrix(
        (np.full(ends.size, 10.0 * _FIRM), (np.repeat(np.arange(len(records)), 2), ends.ravel())),
        (len(records), len(graph.poses)),
    )
    common = (B @ B.T + E @ E.T).tocsr()
    common.data[common.data < _FIRM] = 0.0
    common.eliminate_zeros()
    return np.asarray(scipy.sparse.csgraph.connected_components(common, directed=False)[1])
