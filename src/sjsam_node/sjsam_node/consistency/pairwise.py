# SPDX-License-Identifier: Apache-2.0
"""Closures that can be true together: those that agree with the odometry and with each other.

Two closures over the same stretches of way are compared by the odometry between them (pairwise consistency, Mangelson
et al. 2018): of those that exclude each other the set that more landmarks speak for is selected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sjsam_node.consistency.conditions import CLOSURE_PROBABILITY, ConsistencyConfig, is_among
from sjsam_node.graph.links import Link, Status
from sjsam_node.graph.map_graph import BoolArray, MapGraph
from sjsam_node.loop_closure.verification import ClosureConfig
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus


@dataclass(frozen=True, eq=False)
class Selection:
    """Closures to add to the map, and those of the map to remove for them."""

    added: list[Link] = field(default_factory=list)
    removed: list[Link] = field(default_factory=list)


@dataclass(frozen=True)
class PairwiseConsistency:
    """Selects closures by what they say of the same stretches of way; the map's estimate has no part in it."""

    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    drift: ClosureConfig = field(default_factory=ClosureConfig)

    def selected(self, graph: MapGraph, found: list[Link], refused: Sequence[Link], least: float) -> Selection:
        """Closures to add and to remove: of those that exclude each other the set that most landmarks speak for.

        What the map could judge, and found consistent, excludes nothing that it holds. Those ``refused`` before join
        one that was found; if the map is sure of none, more landmarks than ``least`` must speak for them.
        """
        if not found:
            return Selection()
        consistent = [k for k in found if k.status is Status.CONSISTENT]
        if len(consistent) == len(found):
            return Selection(consistent)
        sure = [k for k in found if k.status is not Status.INCONSISTENT]
        best = max(sure or found, key=lambda k: len(k.pairs))
        ends = {k.ends for k in found}
        offered = [*found, *(k for k in refused if k.ends not in ends)]
        excluded = self.excluded(graph, best, offered)
        agreeing = [k for k, is_off in zip(offered, excluded, strict=True) if k is best or not is_off]
        agreeing, rivals = self.with_rivals(graph, agreeing, [k for k in graph.links if k.is_closure], ends)
        group = agreeing if rivals or not sure else [k for k in agreeing if is_among(k, sure)]
        support = support_of(graph, group)
        enough = support >= support_of(graph, rivals) if rivals else bool(sure) or len(group) > len(found)
        if not sure:  # what was refused is tried again once clearly more speaks for it
            enough = enough and support > least
        return Selection([k.with_status(Status.CONSISTENT) for k in group], rivals) if enough else Selection()

    def with_rivals(
        self, graph: MapGraph, agreeing: list[Link], held: list[Link], found: set[tuple[int, int]]
    ) -> tuple[list[Link], list[Link]]:
        """Closures that would be held together, and those held that they exclude.

        One that waits speaks only against what a ``found`` one (by its ends) speaks against too: a false one, of other
        stretches of way, would else take true closures from the map with it.
        """
        if not held:
            return agreeing, []
        excluded = [self.excluded(graph, k, held) for k in agreeing]
        by_found = np.any([x for k, x in zip(agreeing, excluded, strict=True) if k.ends in found], axis=0)
        group = [k for k, x in zip(agreeing, excluded, strict=True) if not np.any(x & ~by_found)]
        return group, [k for k, is_off in zip(held, by_found, strict=True) if is_off]

    def against_odometry(self, graph: MapGraph, links: Sequence[Link]) -> BoolArray:
        """Mask of links that contradict the odometry between their records."""
        if not links:
            return np.empty(0, dtype=bool)
        ends = np.array([k.ends for k in links])
        T, path_length = graph.odometry_between(ends[:, 0], ends[:, 1])
        return self._are_off(T, np.array([k.T for k in links]), np.array([k.covariance for k in links]), path_length)

    def excluded(self, graph: MapGraph, one: Link, others: Sequence[Link]) -> BoolArray:
        """Mask of links that say something else than ``one`` of the same two stretches of way."""
        if not others:
            return np.empty(0, dtype=bool)
        out = np.zeros(len(others), dtype=bool)
        ends = np.array([k.ends for k in others])
        from_one, to_one = np.full(len(others), one.first), np.full(len(others), one.second)
        for is_inverted in (False, True):
            before, path_length = graph.odometry_between(from_one, ends[:, int(is_inverted)])
            after, way_back = graph.odometry_between(ends[:, 1 - int(is_inverted)], to_one)
            same_ways = np.flatnonzero(np.isfinite(before[:, 0, 0]) & np.isfinite(after[:, 0, 0]))
            if not len(same_ways):
                continue
            links = [others[k].inverted() if is_inverted else others[k] for k in same_ways.tolist()]
            T = before[same_ways] @ np.array([k.T for k in links]) @ after[same_ways]
            covariance = one.covariance + np.array([k.covariance for k in links])
            way = (path_length + way_back)[same_ways]
            out[same_ways] |= self._are_off(T, np.broadcast_to(one.T, T.shape), covariance, way)
        return out

    def _are_off(
        self, T: FloatArray, T_claimed: FloatArray, covariance: FloatArray, path_length: FloatArray
    ) -> BoolArray:
        """Mask of claimed poses (n, 4, 4) further from ``T`` than odometry drifts on a ``path_length`` (n,) m.

        Not where ``T`` is NaN.
        """
        known, drift = np.isfinite(T[:, 0, 0]), self.drift
        error = boxminus(T_claimed[known], T[known])
        turn = drift.drift_angle * path_length[known]
        shift = drift.drift * path_length[known] + turn * np.linalg.norm(T[known][:, :3, 3], axis=1)
        spread = np.repeat(np.stack([shift**2, turn**2], axis=1) + 1e-4, 3, axis=1)
        expected = covariance[known] + spread[:, :, None] * np.eye(6)
        nis = np.einsum("ni,ni->n", error, np.linalg.solve(expected, error[..., None])[..., 0])
        out = np.zeros(len(T), dtype=bool)
        out[known] = nis > chi_square_bound(CLOSURE_PROBABILITY, 6)
        return out


def support_of(graph: MapGraph, links: Sequence[Link]) -> int:
    """Number of landmarks that links match, each counted once however often it was seen."""
    sides = []
    for side in (0, 1):
        seen = [graph.landmarks_of(k.ends[side])[k.pairs[:, side]] for k in links]
        sides.append(len(np.unique(np.concatenate(seen))) if seen else 0)
    return min(sides)
