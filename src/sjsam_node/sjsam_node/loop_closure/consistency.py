"""Which loop closures the map holds: those that agree with the odometry, with each other, and with the joined map.

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

import numpy as np

from sjsam_node.graph.links import Link, Status
from sjsam_node.loop_closure.association import variance_factor
from sjsam_node.loop_closure.verification import ClosureConfig
from sjsam_node.smoothing.estimator import local_residual, observation_nis
from sjsam_node.smoothing.smoother import Smoother, UpdateResult
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus
from slam_core.least_squares import chi_square_bound


@dataclass(frozen=True)
class ConsistencyConfig(Config):
    """What a joined map must look like for a closure to be held."""

    outlier_probability: float = parameter(
        0.99999, "share of true matches that a joined map keeps", minimum=0.9, maximum=0.99999999
    )
    outlier_share: float = parameter(
        0.1, "largest share of a submap's matches that are let go at once", minimum=0.0, maximum=1.0
    )
    rounds: int = parameter(1, "updates that a submap may cost beyond its first, to let closures go", minimum=0)
    settling_rounds: int = parameter(6, "the same when the map settles", minimum=0)
    closure_probability: float = parameter(
        0.9999, "share of true closures whose rise of chi2 is accepted", minimum=0.9, maximum=0.9999999
    )
    view_change: float = parameter(
        2.0, "how much larger squared errors of matches from another view are than those in a whole map", minimum=1.0
    )
    max_variance_factor: float = parameter(
        16.0,
        "a map whose submaps seem too sure of themselves by more than this factor holds false closures",
        minimum=1.0,
    )
    waiting: int = parameter(40, "refused closures that are remembered", minimum=1)


@dataclass(frozen=True, eq=False)
class Verdict:
    """The new closures that are held, the number of matches let go, and old closures let go whole."""

    accepted: tuple[Link, ...] = ()
    dropped: int = 0
    removed: tuple[Link, ...] = ()

    def followed_by(self, later: Verdict) -> Verdict:
        """Both verdicts as one."""
        return Verdict(self.accepted + later.accepted, self.dropped + later.dropped, self.removed + later.removed)


@dataclass
class Consistency:
    """Decides which closures the smoother's map holds; ``refused`` wait, oldest first."""

    smoother: Smoother
    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    drift: ClosureConfig = field(default_factory=ClosureConfig)
    refused: list[Link] = field(default_factory=list)

    def update(self, found: Sequence[Link], newest: int) -> tuple[UpdateResult, Verdict]:
        """Update the map with the closures that it can live with; the others wait.

        ``newest`` is the record whose component is joined, with or without closures.
        """
        found = [k for k in found if not self._is_against_odometry(k)]
        added, removed = self._selected(found)
        self._wait(k for k in found if not _is_in(k, added))
        if not added and not removed:
            return self.smoother.update(newest), Verdict()
        before, checkpoint = self.smoother.totals(), self.smoother.checkpoint()
        offered = [*self.smoother.graph.links, *added]
        result = self.smoother.update(newest, added, removed)
        result = self._evaluate(newest, result, self.config.rounds)
        verdict = self._verdict(added, offered)
        if self._is_better(verdict, before, newest):
            self.refused = [k for k in self.refused if not _is_in(k, added)]
            return result, verdict
        self.smoother.restore(checkpoint)
        self._wait(added)
        return self.smoother.update(newest), Verdict()

    def settle(self, newest: int) -> Verdict:
        """Let go what the settled map contradicts, until nothing is left or it has been evaluated often enough."""
        offered = list(self.smoother.graph.links)
        self._evaluate(newest, self.smoother.result(self.smoother.graph.component(newest)), self.config.settling_rounds)
        return self._verdict([], offered)

    def _wait(self, links: Iterable[Link]) -> None:
        known = {k.ends for k in self.refused}
        waiting = [k.with_status(Status.INCONSISTENT) for k in links if k.ends not in known]
        self.refused = [*self.refused, *waiting][-self.config.waiting :]

    # -- pairwise ------------------------------------------------------------------------------------------------------

    def _selected(self, found: list[Link]) -> tuple[list[Link], list[Link]]:
        """Closures to add and to remove: of those that exclude each other the set that most landmarks speak for."""
        held = self._closures()
        consistent = [k for k in found if k.status is Status.CONSISTENT]
        if not found:
            return [], [k for k in held if self._is_against_odometry(k)]
        best = max(consistent or found, key=lambda k: len(k.pairs))
        agreeing = [k for k in [*found, *self.refused] if k is best or not self._exclude(k, best)]
        rivals = [k for k in held if any(self._exclude(k, other) for other in agreeing)]
        group = agreeing if rivals or not consistent else [k for k in agreeing if _is_in(k, consistent)]
        enough = len(group) > len(found) or bool(consistent)
        if rivals:
            enough = self._support(group) >= self._support(rivals)
        return ([k.with_status(Status.CONSISTENT) for k in group], rivals) if enough else ([], [])

    def _support(self, links: Sequence[Link]) -> int:
        """Number of landmarks that links match, each counted once however often it was seen."""
        graph, sides = self.smoother.graph, []
        for side in (0, 1):
            seen = [graph.records[k.ends[side]].first_observation + k.pairs[:, side] for k in links]
            sides.append(len(np.unique(graph.landmark_of[np.concatenate(seen)])) if seen else 0)
        return min(sides)

    def _closures(self) -> list[Link]:
        return [link for link in self.smoother.graph.links if link.is_closure]

    def _is_against_odometry(self, link: Link) -> bool:
        graph = self.smoother.graph
        T = graph.odometry_between(link.first, link.second)
        return T is not None and self._is_off(link, T, link.covariance, graph.way_between(link.first, link.second))

    def _exclude(self, one: Link, other: Link) -> bool:
        """Whether two links say different things of the same two stretches of way."""
        graph = self.smoother.graph
        for link in (other, other.inverted()):
            before = graph.odometry_between(one.first, link.first)
            after = graph.odometry_between(link.second, one.second)
            if before is not None and after is not None:
                way = graph.way_between(one.first, link.first) + graph.way_between(link.second, one.second)
                return self._is_off(one, before @ link.T @ after, one.covariance + link.covariance, way)
        return False

    def _is_off(self, link: Link, T: FloatArray, covariance: FloatArray, way: float) -> bool:
        """Whether a link is further from ``T`` than odometry drifts on a ``way`` (m)."""
        error, drift = boxminus(link.T, T), self.drift
        turn = drift.drift_angle * way
        shift = drift.drift * way + turn * float(np.linalg.norm(T[:3, 3]))
        expected = covariance + np.diag([shift**2 + 1e-4] * 3 + [turn**2 + 1e-4] * 3)
        return float(error @ np.linalg.solve(expected, error)) > chi_square_bound(self.config.closure_probability, 6)

    # -- in the joined map ---------------------------------------------------------------------------------------------

    def _is_better(self, verdict: Verdict, before: tuple[float, int], newest: int) -> bool:
        """Whether chi2 has risen no more than true matches make it rise, or fallen by more than the loss of true
        matches makes it fall. ``before``: chi2 and redundancy.
        """
        cost, redundancy = self.smoother.totals()
        rise, dof = cost - before[0], redundancy - before[1]
        if not verdict.accepted:
            return bool(verdict.removed) and self._excess(-rise, -dof, newest) > 0.0
        # Closures that contradict the covariances, but not the drift to expect, move the map once for all of them.
        known = max(k.error for k in verdict.accepted)
        outweighed = self._support(verdict.removed) <= self._support(verdict.accepted)
        return outweighed and self._excess((rise - known) / self.config.view_change, dof, newest) <= 0.0

    def _excess(self, rise: float, dof: int, newest: int) -> float:
        """How far chi2 rose above what true matches explain. Submaps that are too sure of themselves make every
        closure look bad: the bound is in units of the map's own variance factor (Baarda 1968), never below one.
        """
        result = self.smoother.result(self.smoother.graph.component(newest))
        factor = (result.cost - max(rise, 0.0)) / max(result.redundancy, 1)
        factor = min(max(1.0, factor), self.config.max_variance_factor)
        return float(rise - factor * chi_square_bound(self.config.closure_probability, max(dof, 1)))

    def _evaluate(self, newest: int, result: UpdateResult, rounds: int) -> UpdateResult:
        """Let go what the joined map contradicts: whole closures with an update each, single matches with the next."""
        for _ in range(rounds):
            nis = self._nis(self.smoother.graph.component(newest))
            gate = self._gate(nis)
            worst = max(self._closures(), key=lambda k: self._median_nis(k, nis), default=None)
            if worst is None or self._median_nis(worst, nis) <= gate:
                self._drop_outliers(nis, gate, newest)
                break
            result = self.smoother.update(newest, removed=[worst])
        return result

    def _gate(self, nis: FloatArray) -> float:
        """Squared error beyond which a match is none, in units of the map's own variance factor."""
        factor = min(variance_factor(nis[np.isfinite(nis)]), self.config.max_variance_factor)
        return factor * chi_square_bound(self.config.outlier_probability, 3)

    def _nis(self, component: int) -> FloatArray:
        """Squared error of every observation as the rest of its submap predicts it, NaN where it ties nothing;
        (observations,), 3 degrees of freedom each.
        """
        graph, assembled = self.smoother.graph, self.smoother.assembled(component)
        out = np.full(len(graph.points), np.nan)
        for i, reduced in zip(assembled.records, assembled.reduced, strict=True):
            if len(reduced.shared):
                rows = graph.records[i].observations[reduced.shared]
                out[rows] = observation_nis(local_residual(graph, graph.records[i], reduced), reduced.information)
        return out

    def _median_nis(self, link: Link, nis: FloatArray) -> float:
        """Median squared error of a link's matches; the worse of its two submaps."""
        records = self.smoother.graph.records
        sides = [nis[records[link.ends[k]].first_observation + link.pairs[:, k]] for k in (0, 1)]
        return max((float(np.median(s[np.isfinite(s)])) for s in sides if np.isfinite(s).any()), default=0.0)

    def _drop_outliers(self, nis: FloatArray, gate: float, newest: int) -> None:
        """Let go the worst matches of each record that are beyond the gate; the next update goes without them."""
        graph = self.smoother.graph
        beyond = np.nonzero(np.nan_to_num(nis) > gate)[0]
        outliers: set[int] = set()
        for i in np.unique(graph.record_of[beyond]).tolist():
            rows = graph.records[i].observations
            allowed = max(1, int(self.config.outlier_share * np.isfinite(nis[rows]).sum()))
            own = beyond[graph.record_of[beyond] == i]
            outliers.update(own[np.argsort(-nis[own], kind="stable")[:allowed]].tolist())
        if outliers:
            smaller = [(k, self._without(k, outliers)) for k in graph.links]
            self.smoother.replace([k for k, s in smaller if s is not k], [s for k, s in smaller if s and s is not k])

    def _without(self, link: Link, observations: set[int]) -> Link | None:
        """The link without pairs that name any of the observations; None for a closure with fewer than three left."""
        first = [self.smoother.graph.records[i].first_observation for i in link.ends]
        bad = np.isin(link.pairs + np.array(first), list(observations)).any(axis=1)
        if not bad.any():
            return link
        kept = link.pairs[~bad]
        return replace(link, pairs=kept) if len(kept) >= 3 or not link.is_closure else None

    def _verdict(self, added: Sequence[Link], offered: Sequence[Link]) -> Verdict:
        """What became of the links there were, of which ``added`` are new."""
        held = {(k.ends, k.is_closure): k for k in self.smoother.graph.links}
        left = sum(len(k.pairs) for k in held.values())
        accepted = tuple(k for k in added if (k.ends, True) in held)
        removed = tuple(k for k in offered if k.is_closure and not _is_in(k, added) and (k.ends, True) not in held)
        return Verdict(accepted, sum(len(k.pairs) for k in offered) - left, removed)


def _is_in(link: Link, links: Iterable[Link]) -> bool:
    """Whether a link between the same two records is among others."""
    return any(k.ends == link.ends for k in links)
