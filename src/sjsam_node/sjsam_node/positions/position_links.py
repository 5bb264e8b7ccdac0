# SPDX-License-Identifier: Apache-2.0
"""Positions in a fixed frame, joined with the map: each submap's are one more submap, which starts in that frame.

Its landmarks are the positions, and the submap has where its antenna was (:mod:`sjsam_node.positions.antenna`). A link
says which are the same, and the joint problem does the rest, as with tags of which it is known where they are.
The map's frame stays as it is. Where the fixed frame lies in it is one more unknown, and so every position is worth
what it says beyond that. Until that frame is determined (:mod:`sjsam_node.positions.fixed_frame`) positions wait.

A position is believed if the others of its submap, the map and the odometry's drift agree with it. Those that do not
are counted, and tie nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from sjsam_node.graph.links import Link, Prior
from sjsam_node.graph.map_graph import ALL, POSITIONS, MapGraph
from sjsam_node.graph.position_ids import is_position_id, position_stamps
from sjsam_node.loop_closure.association import MAX_VARIANCE_FACTOR, Alignment, PointSet, agreeing
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.loop_closure.verification import Verifier
from sjsam_node.positions.fixed_frame import find_frame
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.thinning import thinned
from slam_core.geometry import (
    FloatArray,
    compose_covariance,
    inverse_jacobian,
    invert_transform,
    make_transform,
    transform_points,
)
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.types import ORIGIN_SIGMA, Counters, PoseEstimate, PositionReading, Submap

USED, REFUSED = "positions_used", "positions_refused"
_EXACT, _NOTHING = ORIGIN_SIGMA**2 * np.eye(6), np.zeros((6, 6))
_LEAF = 1e-4 * np.eye(6)
"""Covariance of the end of a submap of positions. Nothing hangs on it, so that its size says nothing; were it exact,
far from the start, the joint problem would lose digits."""

_GROWTH = 1.1
"""Factor by which the positions that wait grow before their frame is looked for again: all looks cost little more."""
_MOST_RECORDS = 200
"""Records that a frame is looked for with, at most."""

_TOGETHER = 4
"""Positions of a submap that agree with each other, from which on the map may be wrong."""


@dataclass
class PositionLinks:
    """Joins positions with the records of a map; ``waiting``: readings of records that are not joined yet."""

    estimate: MapEstimate
    verifier: Verifier
    counters: Counters
    waiting: dict[int, tuple[PositionReading, ...]] = field(default_factory=dict)
    _looked_at: dict[int, int] = field(default_factory=dict)

    @property
    def graph(self) -> MapGraph:
        """Graph that positions are joined with."""
        return self.estimate.graph

    @property
    def waiting_count(self) -> int:
        """Number of the readings that wait."""
        return sum(map(len, self.waiting.values()))

    def add(self, record: int, readings: Sequence[PositionReading]) -> None:
        """Take the readings for which a new record has places of the antenna."""
        if readings:
            self.waiting[record] = tuple(readings)

    def look_again(self) -> list[int]:
        """Have the frame looked for whatever has come since; a record of each component in which positions wait."""
        self._looked_at.clear()
        return list({self.estimate.state.component(i): i for i in self.waiting}.values())

    def join(self, new: int) -> list[int]:
        """Link what waits in the component of a new record; numbers of the records of positions that this made."""
        component = self.estimate.state.component(new)
        own = [i for i in self.waiting if self.estimate.state.component(i) == component]
        if not own:
            return []
        base = self._base()
        if base is None or self.estimate.state.component(base) != component:
            return self._aligned(own, base) if self._is_due(component, own) else []
        return [made for i in own if (made := self._near(i, base)) is not None]

    def _is_due(self, component: int, records: Sequence[int]) -> bool:
        """True if so much more waits since the frame of a component was looked for that it is worth the time."""
        count = sum(len(self.waiting[i]) for i in records)
        if count < _GROWTH * self._looked_at.get(component, 0):
            return False
        self._looked_at[component] = count
        return True

    def _base(self) -> int | None:
        """The first record of positions: where it starts all others do."""
        found = np.nonzero(self.graph.is_position)[0]
        return int(found[0]) if len(found) else None

    def _aligned(self, records: Sequence[int], base: int | None) -> list[int]:
        """Link records of a component whose place in the fixed frame is not known, once it can be found.

        Of very many some along the whole way; the others, which wait for the next submap, are near these.
        """
        records = [records[k] for k in np.unique(np.linspace(0, len(records) - 1, _MOST_RECORDS).astype(np.int64))]
        state, middle = self.estimate.state, records[len(records) // 2]
        starts = [state.start(i) for i in records]
        places = [
            transform_points(T, self.graph.records[i].submap.landmarks[_antenna_rows(self.graph, i)])
            for T, i in zip(starts, records, strict=True)
        ]
        readings, counts = [r for i in records for r in self.waiting[i]], [len(self.waiting[i]) for i in records]
        positions, noise = np.array([r.position for r in readings]), np.array([r.covariance for r in readings])
        seen = [self._seen_from(i, middle) for i in records]
        ways = np.array([self.graph.path_length_between(middle, i) for i in records])
        drift = np.array([_variance_of(*prior) for prior in seen]) + (self.verifier.config.drift * ways) ** 2
        found = find_frame(np.concatenate(places), positions, noise, np.repeat(drift, counts))
        if found is None:
            return []
        shift = np.median(positions[found.agrees], axis=0) if base is None else self._shift(base)
        to_base = make_transform(np.eye(3), shift)
        T_map_base, of_frame = found.T @ to_base, compose_covariance(found.T, found.covariance, to_base, _NOTHING)
        made, agrees = [], np.split(found.agrees, np.cumsum(counts)[:-1])
        for i, T_map, (T_middle, of_map), way, kept in zip(records, starts, seen, ways.tolist(), agrees, strict=True):
            T_base = invert_transform(T_map) @ T_map_base
            covariance = compose_covariance(invert_transform(T_map), _NOTHING, T_map_base, of_frame)
            covariance += compose_covariance(T_middle, of_map, invert_transform(T_middle) @ T_base, _NOTHING)
            believed = self._believed(i, self._drifted(T_base, covariance, way), shift, np.nonzero(kept)[0])
            made += self._linked(i, believed.pairs[:, 0], T_base, _EXACT, shift)
        return made

    def _seen_from(self, record: int, other: int) -> tuple[FloatArray, FloatArray]:
        """T_record_other in one component with its covariance; certain where the map does not say that."""
        state = self.estimate.state
        prior = self.estimate.relative_pose(record, other) if record != other else None
        if prior is None or prior.covariance is None:
            return invert_transform(state.start(record)) @ state.start(other), _EXACT
        return prior.T, prior.covariance

    def _near(self, record: int, base: int) -> int | None:
        """Link a record whose place in the fixed frame the map knows; None if it does not yet, or none agrees."""
        prior = self.estimate.relative_pose(record, base)
        if prior is None or prior.covariance is None:
            return None
        prior, shift = self._drifted(prior.T, prior.covariance, self._way_since_positions(record)), self._shift(base)
        found = self._believed(record, prior, shift, np.arange(len(self.waiting[record])))
        made = self._linked(record, found.pairs[:, 0], found.T, found.covariance, shift)
        return made[0] if made else None

    def _believed(self, record: int, prior: Prior, shift: FloatArray, among: IntArray) -> Alignment:
        """Readings of a record, ``among`` some, that agree with the map and with each other.

        A map too sure of itself may agree with none: several that agree with each other are believed all the same.
        """
        readings = self.waiting[record]
        points = at_start(self.graph.records[record]).select(_antenna_rows(self.graph, record))
        measured = PointSet(
            np.array([r.position for r in readings]) - shift, block_diag(*(r.covariance for r in readings)),
            points.descriptors,
        )  # fmt: skip
        pairs, association = np.stack([among, among], axis=1), self.verifier.config.association
        found = agreeing(points, measured, pairs, prior, association)
        if len(found.pairs) or len(pairs) < _TOGETHER or prior.covariance is None:
            return found
        loose = Prior(prior.T, MAX_VARIANCE_FACTOR * prior.covariance)
        more = agreeing(points, measured, pairs, loose, association)
        return more if len(more.pairs) >= _TOGETHER else found

    def _drifted(self, T: FloatArray, covariance: FloatArray, way: float) -> Prior:
        """A place ``T`` as a record sees it that has drifted, and so turned, along a ``way`` (m)."""
        drift = compose_covariance(np.eye(4), self.verifier.drift(way), T, _NOTHING)
        return Prior(T, covariance + drift)

    def _way_since_positions(self, record: int) -> float:
        """Way of an agent from the nearest of its records that has positions in the map, else its whole way (m)."""
        graph, run = self.graph, self.graph.records[record].key[:2]
        tied = graph.linked[graph.is_position[graph.linked[:, 1]], 0].tolist()
        own = [i for i in tied if graph.records[i].key[:2] == run]
        first = next(i for i, r in enumerate(graph.records) if r.key[:2] == run)
        return min(graph.path_length_between(i, record) for i in own or [first])

    def _shift(self, base: int) -> FloatArray:
        """Start (3,) m of the records of positions in the fixed frame: near the map, as numbers ought to be."""
        return np.asarray(-self.graph.records[base].submap.end_pose[:3, 3])

    def _linked(
        self, record: int, kept: IntArray, T: FloatArray, covariance: FloatArray, shift: FloatArray
    ) -> list[int]:
        """The record of positions that is made of those of ``record`` that are ``kept``, linked; none without any."""
        readings, submap = self.waiting.pop(record), self.graph.records[record].submap
        self._count(REFUSED, len(readings) - len(kept))
        if not len(kept):
            return []
        self._count(USED, len(kept))
        rows = _antenna_rows(self.graph, record)[kept]
        base = self._base()
        start = None if base is None else self.graph.records[base].start
        chosen = [readings[k] for k in kept.tolist()]
        made = self.estimate.add_submap(
            _positions_submap(submap, chosen, rows, shift), start, self.estimate.state.start(record) @ T, ALL
        )
        pairs = np.stack([rows, np.arange(len(kept))], axis=1)
        self.estimate.add_links([Link(record, made, pairs, T, covariance)])
        return [made]

    def _count(self, name: str, amount: int) -> None:
        if amount:
            self.counters.add(name, amount)


def positions_text(counts: Mapping[str, int], waiting: int) -> str:
    """Line for a user whose rig heard positions, by the map's counts of this run and the number of those that wait."""
    used, refused = counts.get(USED, 0), counts.get(REFUSED, 0)
    if not used and not refused:
        return (
            f"{waiting} positions wait, since where their frame lies in the map is not determined: they "
            "change nothing. They must agree with the way, and be spread along two directions by more than they and "
            "the map err"
        )
    more = f", {waiting} wait for a tie between their submaps and those with positions" if waiting else ""
    return f"{used} positions joined with the map, {refused} refused{more}"


def readings_of(positions: Submap) -> tuple[PositionReading, ...]:
    """The readings that a submap of positions was made of."""
    n, k = len(positions.landmarks), np.arange(len(positions.landmarks))
    own = positions.covariance[6:, 6:].reshape(n, 3, n, 3)[k, :, k, :]
    stamps = position_stamps(positions.landmark_ids).tolist()
    places = positions.landmarks - positions.end_pose[:3, 3]
    return tuple(PositionReading(s, p, P) for s, p, P in zip(stamps, places, own, strict=True))


def _variance_of(T: FloatArray, covariance: FloatArray) -> float:
    """Variance (m2) of where a record is, seen from another one that it sees at ``T``."""
    J = inverse_jacobian(T)
    return float(np.linalg.eigvalsh((J @ covariance @ J.T)[:3, :3])[-1])


def without_antenna(submap: Submap) -> Submap:
    """The submap as it came, without places of the antenna."""
    return thinned(submap, np.nonzero(~is_position_id(submap.landmark_ids))[0])


def _antenna_rows(graph: MapGraph, record: int) -> IntArray:
    return np.nonzero(is_position_id(graph.records[record].submap.landmark_ids))[0]


def _positions_submap(submap: Submap, readings: Sequence[PositionReading], rows: IntArray, shift: FloatArray) -> Submap:
    """Readings as a submap that starts ``shift`` (3,) m from the fixed frame's origin, and ends there."""
    n, end = len(readings), make_transform(np.eye(3), -shift)
    stamps = submap.start_stamp_ns, submap.end_stamp_ns
    path = (PoseEstimate(stamps[0], np.eye(4), _EXACT), PoseEstimate(stamps[1], end, _LEAF))
    covariance = block_diag(_LEAF, *(r.covariance for r in readings))
    return Submap(
        f"{POSITIONS}{submap.agent}", submap.index, *stamps, end, np.array([r.position for r in readings]) - shift,
        covariance, submap.landmark_ids[rows], np.ones(n, np.int32),
        np.zeros((n, submap.descriptors.shape[1]), np.float32), path, follows_previous=False, session=submap.session,
    )  # fmt: skip
