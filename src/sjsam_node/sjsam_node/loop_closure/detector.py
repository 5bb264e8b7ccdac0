# SPDX-License-Identifier: Apache-2.0
"""Links between submaps: to the ones just before, to ones the estimate says are near, and to ones that look alike.

Candidates come from where the map believes the new submap to be and from what it looks like; geometry verifies them
(:mod:`sjsam_node.loop_closure.verification`). Where the map cannot tell, a link is believed if chance would hardly make
one like it, by itself (:mod:`sjsam_node.loop_closure.evidence`) or in a cycle that closes
(:mod:`sjsam_node.loop_closure.cycles`); otherwise it waits. A place is compared with a bounded number of submaps, and
with none that show nothing new.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from sjsam_node.graph.links import Link, Prior, Status
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.loop_closure.association import Alignment, PointSet, match
from sjsam_node.loop_closure.cycles import Hop, cycles_through
from sjsam_node.loop_closure.near_pairs import NearPairs
from sjsam_node.loop_closure.place_recognition import PlaceIndex
from sjsam_node.loop_closure.point_sets import at_end, at_start
from sjsam_node.loop_closure.redundancy import RedundancyCheck
from sjsam_node.loop_closure.verification import (
    ALIKE_CANDIDATES,
    CLOSURE_PROBABILITY,
    INFORMATIVE_SIGMA,
    LEAST_NEWS_SHARE,
    LINKED_SUBMAPS,
    MAX_FALSE_ALARMS,
    MAX_PENDING_LINKS,
    MIN_NEAR_INLIERS,
    NEAR_CANDIDATES,
    NEAR_DISTANCE,
    RANSAC_DISTANCE,
    ClosureConfig,
    Verifier,
    largest_sigma,
)
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.smoothing.state import EstimateState
from slam_core.geometry import FloatArray, compose_covariance
from slam_core.linear_algebra.block_pattern import IntArray

_BRIDGED_SIGMA = 0.08
"""A submap whose end is known no better than this (m) was carried on without images: the next is found by closures."""


_AT_ONCE = 128
"""Pairs that are compared elsewhere before what was found of them is looked at."""


@dataclass(frozen=True, eq=False)
class RecordPair:
    """Two records to compare around a prior, by looks too where ``by_looks``; ``path_length``: of the way between."""

    first: int
    second: int
    prior: Prior | None
    path_length: float
    by_looks: bool


Found = tuple[Alignment | None, Status]
Compare = Callable[[Sequence[RecordPair]], Sequence[Found]]


@dataclass
class LoopDetector:
    """Finds and verifies the links of a new record; ``pending`` closures wait for others to close a cycle with."""

    estimate: MapEstimate
    config: ClosureConfig = field(default_factory=ClosureConfig)
    verifier: Verifier = field(init=False)
    index: PlaceIndex = field(init=False)
    near: NearPairs = field(init=False)
    pending: list[Link] = field(default_factory=list)
    is_refuted: Callable[[int, int, Alignment], bool] = lambda first, second, found: False
    """True if something else than looks says that an alignment of two records is false."""
    compare: Compare | None = None
    """Compares many pairs at once, elsewhere; without it each is compared where it is asked for."""
    _alarms: dict[frozenset[int], float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.verifier = Verifier(self.config)
        self.index = PlaceIndex(self.config.places)
        noise = self.config.association.position_noise
        self.near = NearPairs(NEAR_DISTANCE, 4 * NEAR_CANDIDATES, noise)

    @property
    def graph(self) -> MapGraph:
        """Graph in which links are looked for."""
        return self.estimate.graph

    def sequential(self, chain: list[int], new: int) -> list[Link]:
        """Links of record ``new`` to the records ``chain`` before it, newest first, by their odometry.

        To each by what the newer ones have not linked already.
        """
        graph, links = self.graph, []
        T, covariance = np.eye(4), np.zeros((6, 6))
        left, taken = np.arange(len(graph.records[new].observations)), np.empty(0, dtype=np.int64)
        for k, previous in enumerate(chain[:LINKED_SUBMAPS]):
            record, threshold = graph.records[previous], self.config.association.descriptor_threshold
            end, end_covariance = record.submap.end_pose, record.submap.covariance[:6, :6]
            if np.trace(end_covariance[:3, :3]) > _BRIDGED_SIGMA**2:
                break  # gates as wide as this let look-alikes through
            points = at_start(graph.records[new]).at(left)
            alike = (record.submap.descriptors @ points.descriptors.T >= threshold).any(axis=1)
            there = np.nonzero(alike & ~np.isin(graph.landmarks_of(previous), taken))[0]
            found = match(at_end(record, there), points, Prior(T, covariance if k else None), self.config.association)
            if len(found.pairs):
                pairs = np.stack([there[found.pairs[:, 0]], left[found.pairs[:, 1]]], axis=1)
                links.append(Link(previous, new, pairs, end @ found.T,
                                  compose_covariance(end, end_covariance, found.T, found.covariance)))  # fmt: skip
                left = np.setdiff1d(left, pairs[:, 1])
                taken = np.append(taken, graph.landmarks_of(previous)[pairs[:, 0]])
            covariance = compose_covariance(end, end_covariance, T, covariance)
            T = end @ T
        return links

    def closures(self, chain: list[int], new: int) -> list[Link]:
        """Verified links of record ``new`` beyond its chain, consistent or inconsistent with the map; others wait."""
        graph, recent = self.graph, {*range(new, len(self.graph.records)), *chain[:LINKED_SUBMAPS]}
        near = self._near(new, recent)
        known = self._redundancy_check()
        found = self._around(near, new, known)
        if known.is_known(new):  # the map knows where it is: looks would tell nothing more
            return found
        looks = self.index.query(graph.records[new].submap.descriptors, recent | set(near))
        second = at_start(graph.records[new])
        alike = [old for old in looks if self.verifier.is_alike(at_start(graph.records[old]), second)]
        return found + self._verified([(old, new) for old in alike[:ALIKE_CANDIDATES]], known)

    def again(self, record: int, chain: list[int]) -> list[Link]:
        """Links of a record that has further landmarks now: with what it waits to be tied to, and as if it were new."""
        waits = [k.ends for k in self.pending if record in k.ends]
        self.pending = [k for k in self.pending if record not in k.ends]
        self.near.forget({record})
        held = {frozenset(k.ends) for k in self.graph.links}
        found = self._verified(waits, self._redundancy_check())
        known = held | {frozenset(k.ends) for k in found}
        return found + [k for k in self.closures(chain, record) if frozenset(k.ends) not in known]

    def _around(self, near: list[int], new: int, known: RedundancyCheck) -> list[Link]:
        """Links of record ``new`` to those near it, as long as they tell of landmarks that none has told of yet."""
        found: list[Link] = []
        count = len(self.graph.records[new].observations)
        left, pairs = np.ones(count, dtype=bool), [(old, new) for old in near]
        ahead = None if self.compare is None else self._compared_at_once(self.compare, pairs, known, by_looks=False)
        for pair in pairs:
            more = self._verified([pair], known, by_looks=False, ahead=ahead)
            found += more
            told = sum(int(left[k.pairs[:, 1]].sum()) for k in more)
            for k in more:
                left[k.pairs[:, 1]] = False
            if more and told < LEAST_NEWS_SHARE * count:
                break
        return found

    def missed(self, chained: IntArray, most: int) -> list[Link]:
        """Links between records that have come near each other since they were compared, if ever they were.

        Of ``most`` pairs, the nearest; none of those ``chained`` (n, 2) along the odometry. And links that waited, as
        far as they are believed by now.
        """
        waited = self.reconsidered()
        return waited + self._verified(self.near.due(self.estimate.state, chained)[:most], self._redundancy_check())

    def around(self, middle: FloatArray, records: Iterable[int], excluded: set[int]) -> list[int]:
        """Members of ``records`` whose landmarks are around a point (3,) of the map, nearest first."""
        state = self.estimate.state
        candidates = np.array([i for i in records if i not in excluded and not state.is_redundant(i)], dtype=np.int64)
        distance = np.linalg.norm(state.middles(candidates) - middle, axis=1)
        ranked = sorted((d, i) for d, i in zip(distance.tolist(), candidates.tolist(), strict=True)
                        if d < NEAR_DISTANCE)  # fmt: skip
        return [i for _, i in ranked[:NEAR_CANDIDATES]]

    def _near(self, new: int, recent: set[int]) -> list[int]:
        """Older records of the same component whose landmarks are around those of ``new``, nearest first."""
        state = self.estimate.state
        return self.around(_middle(state, new), state.records_in(state.component(new)), recent)

    def _redundancy_check(self) -> RedundancyCheck:
        config, state = self.config, self.estimate.state
        threshold = config.association.descriptor_threshold
        return RedundancyCheck(state, MIN_NEAR_INLIERS, threshold, RANSAC_DISTANCE)

    def _verified(
        self, pairs: list[tuple[int, int]], known: RedundancyCheck, *, by_looks: bool = True,
        ahead: dict[tuple[int, int], Found] | None = None,
    ) -> list[Link]:  # fmt: skip
        """Links between pairs of records that geometry and the map support; none that tell nothing new.

        ``ahead``: what comparing them has found already.
        """
        out: list[Link] = []
        results = ahead or {}
        for k, (old, new) in enumerate(pairs):
            if self.compare is not None and ahead is None and k % _AT_ONCE == 0:
                results = self._compared_at_once(self.compare, pairs[k : k + _AT_ONCE], known, by_looks)
            if known.is_all_known(old, new):
                self.near.note(self.estimate.state, old, new)
                continue
            prior = self.estimate.relative_pose(old, new)
            if prior is not None:
                self.near.note(self.estimate.state, old, new)
            link = self._compared(old, new, prior, by_looks, results.get((old, new)))
            if link is None:
                continue
            if link.status is Status.CONSISTENT:
                known.note(link)
            out += self._judged(link) if link.status is Status.UNINFORMATIVE else [link]
        return out

    def _compared_at_once(
        self, compare: Compare, pairs: list[tuple[int, int]], known: RedundancyCheck, by_looks: bool
    ) -> dict[tuple[int, int], Found]:
        """Comparisons of those of some pairs that may tell something new."""
        left = [pair for pair in pairs if not known.is_all_known(*pair)]
        wanted = [self._comparison(*pair, self.estimate.relative_pose(*pair), by_looks) for pair in left]
        return dict(zip(left, compare(wanted), strict=True))

    def _comparison(self, old: int, new: int, prior: Prior | None, by_looks: bool) -> RecordPair:
        return RecordPair(old, new, prior, self.graph.path_length_between(old, new), by_looks or prior is None)

    def _compared(
        self, old: int, new: int, prior: Prior | None, by_looks: bool, known: Found | None = None
    ) -> Link | None:
        """The closure between two records, if there is one; ``known``: what comparing them has found already."""
        if known is None:
            first, second = (at_start(self.graph.records[i]) for i in (old, new))
            known = compared(self.verifier, first, second, self._comparison(old, new, prior, by_looks))
        found, status = known
        if found is None or self.is_refuted(old, new, found):
            return None
        may_move = status is not Status.INCONSISTENT and prior is not None
        error = self.verifier.error_against(found, prior, 0.0) if may_move and prior is not None else 0.0
        return Link(old, new, found.pairs, found.T, found.covariance, True, error, status)

    def _judged(self, link: Link) -> list[Link]:
        """The link if it is evident, or if a cycle with others that wait is, with these; otherwise it waits."""
        self.pending = [k for k in self.pending if k.ends != link.ends]
        self._alarms.pop(frozenset(link.ends), None)
        if self._log10_false_alarms(link) <= np.log10(MAX_FALSE_ALARMS):
            return [link]
        self.pending = [*self.pending, link][-MAX_PENDING_LINKS:]
        return self._believed(self._evident_cycle(link, cache(self._hop)))

    def reconsidered(self) -> list[Link]:
        """Links that waited and are believed now, or that the map can judge now that it ties their submaps."""
        out: list[Link] = []
        for link in self.pending[:]:
            prior = self.estimate.relative_pose(*link.ends)
            if prior is not None and self._can_judge(link, prior):
                self.pending = [k for k in self.pending if k is not link]
                self.near.note(self.estimate.state, *link.ends)
                again = self._compared(*link.ends, prior, True)
                out += [again] if again is not None and again.status is not Status.UNINFORMATIVE else []
        hop = cache(self._hop)
        for link in self.pending[:]:
            if any(k is link for k in self.pending):  # not believed with another one yet
                out += self._believed(self._evident_cycle(link, hop))
        return out

    def _can_judge(self, link: Link, prior: Prior) -> bool:
        """True if the map, which could not tell, can tell now."""
        found = Alignment(link.pairs, link.T, link.covariance, 0.0, 0)
        is_sure = largest_sigma(prior.covariance) < INFORMATIVE_SIGMA
        return is_sure or self.verifier.is_against(found, prior, self.graph.path_length_between(*link.ends))

    def _believed(self, links: tuple[Link, ...]) -> list[Link]:
        """The links of ``pending`` between the same records, which wait no longer."""
        ends = {frozenset(k.ends) for k in links}
        out = [k for k in self.pending if frozenset(k.ends) in ends]
        self.pending = [k for k in self.pending if frozenset(k.ends) not in ends]
        return out

    def _evident_cycle(self, link: Link, hop: Hop) -> tuple[Link, ...]:
        """The links of the most improbable cycle of links that wait, if it closes and is improbable enough."""
        others = [k for k in self.pending if k is not link]
        cycles, found = list(cycles_through(link, others, hop)), []
        for k, cycle in enumerate(cycles):
            if cycle.closes(CLOSURE_PROBABILITY):
                weakest = max((self._log10_false_alarms(one), one.ends) for one in cycle.links)
                chance = cycle.chance(CLOSURE_PROBABILITY, sum(map(self._reach, weakest[1])))
                found.append((weakest[0] + np.log10(chance * len(cycles)), k))
        best = min(found, default=(np.inf, 0))
        return cycles[best[1]].links if best[0] <= np.log10(MAX_FALSE_ALARMS) else ()

    def _hop(self, first: int, second: int) -> Prior | None:
        """T_first_second by the map, with the drift to expect; None where nothing ties the two."""
        if first == second:
            return Prior(np.eye(4), None)
        prior, path_length = self.estimate.relative_pose(first, second), self.graph.path_length_between(first, second)
        if prior is None or prior.covariance is None:
            return prior
        return Prior(prior.T, prior.covariance + self.verifier.drift(path_length))

    def _log10_false_alarms(self, link: Link) -> float:
        """See :meth:`Verifier.log10_false_alarms`; of a link that waits it is kept."""
        ends = frozenset(link.ends)
        if ends not in self._alarms:
            first, second = (at_start(self.graph.records[i]) for i in link.ends)
            found = Alignment(link.pairs, link.T, link.covariance, 0.0, 0)
            self._alarms[ends] = self.verifier.log10_false_alarms(first, second, found)
        return self._alarms[ends]

    def _reach(self, record: int) -> float:
        """Distance of the landmarks of a record from its start, their median, m."""
        return float(np.median(np.linalg.norm(self.graph.records[record].submap.landmarks, axis=1)))


def compared(verifier: Verifier, first: PointSet, second: PointSet, wanted: RecordPair) -> Found:
    """The alignment of two records' landmarks, if geometry supports one, and what the prior says of it."""
    if not wanted.by_looks:
        return verifier.verify_near(first, second, wanted.prior), Status.CONSISTENT
    return verifier.verify(first, second, wanted.prior, wanted.path_length, wanted.first, wanted.second)


def _middle(state: EstimateState, record: int) -> FloatArray:
    return np.asarray(state.middles(np.array([record]))[0])
