# SPDX-License-Identifier: Apache-2.0
"""Decides which loop closures the map holds: those that agree with the odometry, each other and the joined map.

Two closures over the same stretches of way are compared pairwise by the odometry between them (pairwise consistency,
Mangelson et al. 2018): of those that exclude each other the set that more landmarks speak for is held. What is held is
joined once; then the map is evaluated: a closure whose landmarks disagree with it on the whole is let go, and so are
single matches that stand out. True matches raise chi2 by no more than noise explains; where new ones raise it by more,
they are refused. Refused closures wait: a false one stands alone, true ones add up until they outweigh it.

A submap's closures cost one update, and ``rounds`` more where something is let go; what is left is evaluated again with
the next ones, and when the map settles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import is_

import numpy as np

from sjsam_node.graph.links import Link, Status
from sjsam_node.graph.map_graph import BoolArray
from sjsam_node.loop_closure.association import variance_factor
from sjsam_node.loop_closure.verification import ClosureConfig
from sjsam_node.smoothing.smoother import Smoother, UpdateResult
from slam_core.chi_square import chi_square_bound
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus
from slam_core.linear_algebra.sparse_cholesky import IntArray

_RELIEF = 0.5
"""Share of the strain that may be left for closures to have been its cause."""


@dataclass(frozen=True)
class ConsistencyConfig(Config):
    """Conditions on a joined map for a closure to be held."""

    outlier_probability: float = 0.99999
    """Share of true matches that a joined map keeps."""
    outlier_share: float = 0.1
    """Largest share of a submap's matches that are let go at once."""
    rounds: int = 1
    """Updates that a submap may cost beyond its first, to let closures go."""
    settling_rounds: int = 6
    """The same when the map settles."""
    closure_probability: float = 0.9999
    """Share of true closures whose rise of chi2 is accepted."""
    view_change: float = 2.0
    """Factor by which squared errors of matches from another view are larger than those in a whole map."""
    max_variance_factor: float = parameter(
        16.0,
        "a map whose submaps seem too sure of themselves by more than this factor holds false closures",
        minimum=1.0,
    )
    retry: float = 1.2
    """Growth of the landmarks that speak for refused closures, from which these are tried again."""
    waiting: int = 40
    """Refused closures that are remembered."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The new closures that are held, the number of matches let go, and old closures let go whole."""

    accepted: tuple[Link, ...] = ()
    dropped: int = 0
    removed: tuple[Link, ...] = ()


@dataclass
class Consistency:
    """Decides which closures the smoother's map holds; ``refused`` wait, oldest first."""

    smoother: Smoother
    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    drift: ClosureConfig = field(default_factory=ClosureConfig)
    refused: list[Link] = field(default_factory=list)
    _refused_support: int = 0

    def update(self, found: Sequence[Link], newest: int) -> tuple[UpdateResult, Verdict]:
        """Update the map with the closures that it can live with; the others wait.

        ``newest`` is the record whose component is joined, with or without closures.
        """
        found = [k for k, is_off in zip(found, self._are_against_odometry(found), strict=True) if not is_off]
        added, removed = self._selected(found)
        self._wait(k for k in found if not _is_in(k, added))
        if not added and not removed:
            return self.smoother.update(newest), Verdict()
        sure = [k for k in found if k.status is Status.CONSISTENT]
        tried = self._tried(added, removed, newest)
        if tried is None and 0 < len(sure) < len(added):  # one that the map was not sure of need not take others along
            self._wait(k for k in added if not _is_in(k, sure))
            tried = self._tried(sure, [], newest)
        if tried is not None:
            return tried
        self._wait(added)
        if len(added) > len(found):
            self._refused_support = self._support(added)
        return self.smoother.update(newest), Verdict()

    def _tried(self, added: list[Link], removed: list[Link], newest: int) -> tuple[UpdateResult, Verdict] | None:
        """Update the map with closures and without others; None, and all as it was, if it cannot live with that."""
        before, checkpoint = self.smoother.totals(), self.smoother.checkpoint()
        offered = [*self.smoother.graph.links, *added]
        result = self.smoother.update(newest, added, removed)
        result, outliers = self._evaluate(newest, result, self.config.rounds)
        verdict = self._verdict(added, offered)
        if not self._is_better(verdict, before, newest, outliers):
            self.smoother.restore(checkpoint)
            return None
        self.refused = [k for k in self.refused if not _is_in(k, added)]
        self._refused_support = 0
        return result, verdict

    def settle(self, newest: int) -> Verdict:
        """Let go what the settled map contradicts, until nothing is left or it has been evaluated often enough.

        Without a closure there is nothing that could be false but the filter's own submaps: these are left as they are.
        """
        if not self._closures():
            return Verdict()
        offered, result = list(self.smoother.graph.links), self.smoother.result(self.smoother.graph.component(newest))
        self._evaluate(newest, result, self.config.settling_rounds)
        return self._verdict([], offered)

    def relieve(self) -> Verdict:
        """Treat parts whose submaps contradict each other by more than ``max_variance_factor`` when all is settled.

        They are settled with few of the landmarks that they share, and keep the variance factor that all of them had.
        If they contradict each other still, closures are let go, the worst ones first, if that helps. If it does not,
        the matches between neighbours are: the filter's own chain of submaps stays.
        """
        graph, offered = self.smoother.graph, list(self.smoother.graph.links)
        components = np.unique(graph.component_of).tolist()
        strained = [graph.records_of(c)[0] for c in components if self._strain(c) > self.config.max_variance_factor]
        for record in strained:
            self._doubt(record)
        if strained:
            self.smoother.settle()
        for record in strained:
            self._let_go(record)
        return self._verdict([], offered)

    def _strain(self, component: int) -> float:
        return self.smoother.result(component).strain

    def _doubt(self, record: int) -> None:
        """Keep how much the component of a record is strained."""
        graph = self.smoother.graph
        records, strain = graph.records_of(graph.component(record)), self._strain(graph.component(record))
        graph.doubt[records] = np.maximum(graph.doubt[records], strain)

    def _let_go(self, record: int) -> None:
        """Let go what strains the component of a record."""
        graph = self.smoother.graph
        for _ in range(self.config.settling_rounds):
            strain = self._strain(graph.component(record))
            if strain <= self.config.max_variance_factor:
                return
            own = [k for k in graph.links if graph.component(k.first) == graph.component(record)]
            suspects = self._worst_closures([k for k in own if k.is_closure], self._nis(graph.component(record)))
            checkpoint = self.smoother.checkpoint()
            if suspects and self.smoother.update(record, removed=suspects).strain <= _RELIEF * strain:
                continue
            self.smoother.restore(checkpoint)
            self._doubt(record)
            if neighbours := [k for k in own if not k.is_closure]:
                self.smoother.update(record, removed=neighbours)
            return

    def _worst_closures(self, closures: list[Link], nis: FloatArray) -> list[Link]:
        """Of closures the one that its landmarks contradict most, and those of the same two stretches of way."""
        if not closures:
            return []
        worst = max(closures, key=lambda k: self._median_nis(k, nis))
        near = np.abs(np.array([k.ends for k in closures]) - worst.ends).max(axis=1) <= self.drift.window
        return [k for k, is_near in zip(closures, near, strict=True) if is_near]

    def _wait(self, links: Iterable[Link]) -> None:
        known = {k.ends for k in self.refused}
        waiting = [k.with_status(Status.INCONSISTENT) for k in links if k.ends not in known]
        self.refused = [*self.refused, *waiting][-self.config.waiting :]

    # -- pairwise ------------------------------------------------------------------------------------------------------

    def _selected(self, found: list[Link]) -> tuple[list[Link], list[Link]]:
        """Closures to add and to remove: of those that exclude each other the set that most landmarks speak for.

        What the map could judge, and found consistent, excludes nothing that it holds.
        """
        if not found:
            return [], []
        consistent = [k for k in found if k.status is Status.CONSISTENT]
        if len(consistent) == len(found):
            return consistent, []
        sure = [k for k in found if k.status is not Status.INCONSISTENT]
        best = max(sure or found, key=lambda k: len(k.pairs))
        ends = {k.ends for k in found}
        offered = [*found, *(k for k in self.refused if k.ends not in ends)]
        agreeing = [
            k for k, is_off in zip(offered, self._excluded(best, offered), strict=True) if k is best or not is_off
        ]
        agreeing, rivals = self._with_rivals(agreeing, self._closures(), ends)
        group = agreeing if rivals or not sure else [k for k in agreeing if _is_in(k, sure)]
        support = self._support(group)
        enough = support >= self._support(rivals) if rivals else bool(sure) or len(group) > len(found)
        if not sure:  # what was refused is tried again once clearly more speaks for it
            enough = enough and support > self.config.retry * self._refused_support
        return ([k.with_status(Status.CONSISTENT) for k in group], rivals) if enough else ([], [])

    def _with_rivals(
        self, agreeing: list[Link], held: list[Link], found: set[tuple[int, int]]
    ) -> tuple[list[Link], list[Link]]:
        """Closures that would be held together, and those held that they exclude.

        One that waits speaks only against what a ``found`` one (by its ends) speaks against too: a false one, of other
        stretches of way, would else take true closures from the map with it.
        """
        if not held:
            return agreeing, []
        excluded = [self._excluded(k, held) for k in agreeing]
        by_found = np.any([x for k, x in zip(agreeing, excluded, strict=True) if k.ends in found], axis=0)
        group = [k for k, x in zip(agreeing, excluded, strict=True) if not np.any(x & ~by_found)]
        return group, [k for k, is_off in zip(held, by_found, strict=True) if is_off]

    def _support(self, links: Sequence[Link]) -> int:
        """Number of landmarks that links match, each counted once however often it was seen."""
        graph, sides = self.smoother.graph, []
        for side in (0, 1):
            seen = [graph.records[k.ends[side]].first_observation + k.pairs[:, side] for k in links]
            sides.append(len(np.unique(graph.landmark_of[np.concatenate(seen)])) if seen else 0)
        return min(sides)

    def _closures(self) -> list[Link]:
        return [link for link in self.smoother.graph.links if link.is_closure]

    def _are_against_odometry(self, links: Sequence[Link]) -> BoolArray:
        """Mask of links that contradict the odometry between their records."""
        if not links:
            return np.empty(0, dtype=bool)
        ends = np.array([k.ends for k in links])
        T, way = self.smoother.graph.odometry_between(ends[:, 0], ends[:, 1])
        return self._are_off(T, np.array([k.T for k in links]), np.array([k.covariance for k in links]), way)

    def _excluded(self, one: Link, others: Sequence[Link]) -> BoolArray:
        """Mask of links that say something else than ``one`` of the same two stretches of way."""
        if not others:
            return np.empty(0, dtype=bool)
        out = np.zeros(len(others), dtype=bool)
        for links in (others, [k.inverted() for k in others]):
            ends = np.array([k.ends for k in links])
            before, way = self.smoother.graph.odometry_between(np.full(len(links), one.first), ends[:, 0])
            after, way_back = self.smoother.graph.odometry_between(ends[:, 1], np.full(len(links), one.second))
            T = before @ np.array([k.T for k in links]) @ after
            covariance = one.covariance + np.array([k.covariance for k in links])
            out |= self._are_off(T, np.broadcast_to(one.T, T.shape), covariance, way + way_back)
        return out

    def _are_off(self, T: FloatArray, T_claimed: FloatArray, covariance: FloatArray, way: FloatArray) -> BoolArray:
        """Mask of claimed poses (n, 4, 4) further from ``T`` than odometry drifts on a ``way`` (n,) m.

        Not where ``T`` is NaN.
        """
        known, drift = np.isfinite(T[:, 0, 0]), self.drift
        error = boxminus(T_claimed[known], T[known])
        turn = drift.drift_angle * way[known]
        shift = drift.drift * way[known] + turn * np.linalg.norm(T[known][:, :3, 3], axis=1)
        spread = np.repeat(np.stack([shift**2, turn**2], axis=1) + 1e-4, 3, axis=1)
        expected = covariance[known] + spread[:, :, None] * np.eye(6)
        nis = np.einsum("ni,ni->n", error, np.linalg.solve(expected, error[..., None])[..., 0])
        out = np.zeros(len(T), dtype=bool)
        out[known] = nis > chi_square_bound(self.config.closure_probability, 6)
        return out

    # -- in the joined map ---------------------------------------------------------------------------------------------

    def _is_better(self, verdict: Verdict, before: tuple[float, int], newest: int, outliers: float) -> bool:
        """Tell whether chi2 has changed by no more than true matches make it change.

        It may rise by what true matches add, or fall by more than the loss of true matches makes it fall. ``before``:
        chi2 and redundancy.
        """
        cost, redundancy = self.smoother.totals()
        rise, dof = cost - before[0] - outliers, redundancy - before[1]
        if not verdict.accepted:
            return bool(verdict.removed) and self._excess(-rise, -dof, newest) > 0.0
        # Closures that contradict the covariances, but not the drift to expect, move the map once for all of them.
        known = max(k.error for k in verdict.accepted)
        outweighed = self._support(verdict.removed) <= self._support(verdict.accepted)
        return outweighed and self._excess((rise - known) / self.config.view_change, dof, newest) <= 0.0

    def _excess(self, rise: float, dof: int, newest: int) -> float:
        """Rise of chi2 above what true matches explain.

        Submaps that are too sure of themselves make every closure look bad: the bound is in units of the map's own
        variance factor (Baarda 1968), never below one.
        """
        result = self.smoother.result(self.smoother.graph.component(newest))
        factor = (result.cost - max(rise, 0.0)) / max(result.redundancy, 1)
        factor = min(max(1.0, factor), self.config.max_variance_factor)
        return float(rise - factor * chi_square_bound(self.config.closure_probability, max(dof, 1)))

    def _evaluate(self, newest: int, result: UpdateResult, rounds: int) -> tuple[UpdateResult, float]:
        """Let go what the joined map contradicts: whole closures with an update each, single matches with the next.

        Also returns by how much chi2 will fall without these matches.
        """
        graph = self.smoother.graph
        while True:
            nis = self._nis(graph.component(newest))
            gate = self._gate(nis)
            beyond = np.nonzero(np.nan_to_num(nis) > gate)[0]
            near = np.isin(graph.linked, graph.record_of[beyond]).any(axis=1)
            closures = [k for i in np.nonzero(near)[0].tolist() if (k := graph.links[i]).is_closure]
            worst = max(closures, key=lambda k: self._median_nis(k, nis), default=None)
            if rounds == 0 or worst is None or self._median_nis(worst, nis) <= gate:
                return result, self._drop_outliers(beyond, nis)
            result, rounds = self.smoother.update(newest, removed=[worst]), rounds - 1

    def _gate(self, nis: FloatArray) -> float:
        """Squared error beyond which a match is none, in units of the map's own variance factor."""
        factor = min(variance_factor(nis[np.isfinite(nis)]), self.config.max_variance_factor)
        return factor * chi_square_bound(self.config.outlier_probability, 3)

    def _nis(self, component: int) -> FloatArray:
        """Squared error of every observation as the rest of its submap predicts it, NaN where it ties nothing.

        (observations,), 3 degrees of freedom each.
        """
        graph, assembled = self.smoother.graph, self.smoother.assembled(component)
        out = np.full(len(graph.points), np.nan)
        out[assembled.observations] = assembled.nis()
        return out

    def _median_nis(self, link: Link, nis: FloatArray) -> float:
        """Median squared error of a link's matches; the worse of its two submaps."""
        records = self.smoother.graph.records
        sides = [nis[records[link.ends[k]].first_observation + link.pairs[:, k]] for k in (0, 1)]
        return max((float(np.median(s[np.isfinite(s)])) for s in sides if np.isfinite(s).any()), default=0.0)

    def _drop_outliers(self, beyond: IntArray, nis: FloatArray) -> float:
        """Let go the worst matches of each record of those ``beyond`` the gate; the next update goes without them.

        Returns by how much chi2 falls: by the squared error of each landmark's worst observation.
        """
        graph = self.smoother.graph
        outliers: set[int] = set()
        suspects = np.unique(graph.record_of[beyond]).tolist()
        for i in suspects:
            rows = graph.records[i].observations
            allowed = max(1, int(self.config.outlier_share * np.isfinite(nis[rows]).sum()))
            own = beyond[graph.record_of[beyond] == i]
            outliers.update(own[np.argsort(-nis[own], kind="stable")[:allowed]].tolist())
        if outliers:
            touched = [k for k in graph.links if not set(suspects).isdisjoint(k.ends)]
            smaller = [(k, self._without(k, outliers)) for k in touched]
            rows = np.array(sorted(outliers))
            worst = np.zeros(len(graph.points))
            np.maximum.at(worst, graph.landmark_of[rows], nis[rows])
            self.smoother.replace([k for k, s in smaller if s is not k], [s for k, s in smaller if s and s is not k])
            return float(worst.sum())
        return 0.0

    def _without(self, link: Link, observations: set[int]) -> Link | None:
        """The link without pairs that name any of the observations; None for a closure with fewer than three left."""
        first = [self.smoother.graph.records[i].first_observation for i in link.ends]
        bad = np.isin(link.pairs + np.array(first), list(observations)).any(axis=1)
        if not bad.any():
            return link
        kept = link.pairs[~bad]
        return replace(link, pairs=kept) if len(kept) >= 3 or not link.is_closure else None

    def _verdict(self, added: Sequence[Link], offered: Sequence[Link]) -> Verdict:
        """Verdict on the links there were, of which ``added`` are new."""
        if len(offered) == len(self.smoother.graph.links) and all(map(is_, offered, self.smoother.graph.links)):
            return Verdict(tuple(added))
        held, were = {id(k) for k in self.smoother.graph.links}, {id(k) for k in offered}
        gone = [k for k in offered if id(k) not in held]
        smaller = [k for k in self.smoother.graph.links if id(k) not in were]
        lost = {k.ends for k in gone if k.is_closure} - {k.ends for k in smaller if k.is_closure}
        removed = tuple(k for k in gone if k.is_closure and k.ends in lost and not _is_in(k, added))
        dropped = sum(len(k.pairs) for k in gone) - sum(len(k.pairs) for k in smaller)
        return Verdict(tuple(k for k in added if k.ends not in lost), dropped, removed)


def _is_in(link: Link, links: Iterable[Link]) -> bool:
    """True if a link between the same two records is among others."""
    return any(k.ends == link.ends for k in links)
