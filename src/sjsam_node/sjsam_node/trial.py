"""Whether the joined map can live with new closures: they are joined on trial, and what the map contradicts goes.

True matches raise chi2 by no more than noise explains. On trial, a closure whose matches disagree with the map on the
whole is taken back, the worst first, be it new or old; then single matches that stand out. What is left must explain
itself, and an old closure gives way only to new ones of more matches than it has. Closures that are refused wait: a
false one stands alone, true ones add up until they outweigh a false one that was believed before them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sjsam_node.association import variance_factor
from sjsam_node.closures import ClosureConfig
from sjsam_node.estimator import local_residual, observation_nis
from sjsam_node.joiner import Joiner
from sjsam_node.map_graph import Link, without
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus
from slam_core.least_squares import chi_square_bound

_HALVINGS = 3
"""How often refused links are divided to find the true ones among them: each time doubles the number of trials."""


@dataclass(frozen=True)
class TrialConfig(Config):
    """What a joined map must look like for a closure to be believed."""

    outlier_probability: float = parameter(
        0.99999, "share of true matches that a joined map keeps", minimum=0.9, maximum=0.99999999
    )
    outlier_share: float = parameter(
        0.1, "largest share of a submap's matches that are taken back at once", minimum=0.0, maximum=1.0
    )
    rounds: int = parameter(6, "times a map on trial is searched for false matches", minimum=0)
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
    """The new links that are believed now, the number of matches taken back, and old closures taken back whole."""

    believed: tuple[Link, ...] = ()
    dropped: int = 0
    revoked: tuple[Link, ...] = ()

    def followed_by(self, later: Verdict) -> Verdict:
        """Both verdicts as one."""
        return Verdict(
            self.believed + later.believed, self.dropped + later.dropped, self.revoked + later.revoked
        )  # fmt: skip


@dataclass
class Trials:
    """Judges closures of the map that ``joiner`` holds; ``contested`` are those refused so far, oldest first."""

    joiner: Joiner
    config: TrialConfig = field(default_factory=TrialConfig)
    drift: ClosureConfig = field(default_factory=ClosureConfig)
    contested: list[Link] = field(default_factory=list)

    def hear(self, links: list[Link], contradicted: list[Link], newest: int) -> Verdict:
        """Believe those of some new links that the joined map can live with; the others wait.

        ``contradicted`` look right, but the map says otherwise: they wait at once. ``newest`` is the record whose end
        the agent goes on from.
        """
        links = [link for link in links if not self._contradicts_odometry(link)]
        contradicted = [link for link in contradicted if not self._contradicts_odometry(link)]
        verdict = self._heard(links, newest) if links else None
        taken = _names(verdict.believed) if verdict else set()
        refused = [*contradicted, *(k for k in links if _name(k) not in taken)]
        self.contested = [*self.contested, *refused][-self.config.waiting :]
        return verdict or self._overturned(refused, newest) or self._reconsidered(newest)

    def _heard(self, links: list[Link], newest: int, halvings: int = _HALVINGS) -> Verdict | None:
        """Believe what the map can live with: all of the links, or else what it can of either half, the better first.

        One false link among true ones must not be the end of them all.
        """
        whole = self._tried(links, [], newest)
        if whole is not None or len(links) == 1 or halvings == 0:
            return whole
        offered = [*self.joiner.graph.links, *links]
        ranked = sorted(links, key=lambda k: -len(k.pairs))
        halves = [
            self._heard(part, newest, halvings - 1) for part in (ranked[: len(links) // 2], ranked[len(links) // 2 :])
        ]
        return self._verdict(links, offered, newest) if any(halves) else None

    def _overturned(self, refused: list[Link], newest: int) -> Verdict | None:
        """Believe the best refused link and those waiting that say the same, and none that contradicts them, once
        there is more to say for them.
        """
        if not refused:
            return None
        best = max(refused, key=lambda k: len(k.pairs))
        group = [k for k in self.contested if k is best or not self._contradict(k, best)]
        rivals = [k for k in self._closures() if any(self._contradict(k, link) for link in group)]
        if (len(group) == len(refused) and not rivals) or self._support(rivals) > self._support(group):
            return None
        verdict = self._tried(group, rivals, newest)
        if verdict is not None:
            self.contested = [k for k in self.contested if not any(k is link for link in group)]
        return verdict

    def _support(self, links: Sequence[Link]) -> int:
        """Number of landmarks that links match, each counted once however often it was seen."""
        graph, sides = self.joiner.graph, []
        for side in (0, 1):
            seen = [graph.records[(k.first, k.second)[side]].first_observation + k.pairs[:, side] for k in links]
            sides.append(len(np.unique(graph.landmark_of[np.concatenate(seen)])) if seen else 0)
        return min(sides)

    def _reconsidered(self, newest: int) -> Verdict:
        """Take back closures that contradict the odometry between their submaps, if the map is better off without."""
        against = [link for link in self._closures() if self._contradicts_odometry(link)]
        return (self._tried([], against, newest) if against else None) or Verdict()

    def _closures(self) -> list[Link]:
        return [link for link in self.joiner.graph.links if link.is_closure]

    def _contradicts_odometry(self, link: Link) -> bool:
        graph = self.joiner.graph
        T = graph.odometry_between(link.first, link.second)
        return T is not None and self._is_off(link, T, link.covariance, graph.way_between(link.first, link.second))

    def _contradict(self, one: Link, other: Link) -> bool:
        """Whether two links say different things of the same two stretches of way."""
        graph = self.joiner.graph
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

    def _tried(self, links: list[Link], rivals: list[Link], newest: int) -> Verdict | None:
        """Join with some links and without their rivals; None, and all as it was, if that makes no better map."""
        joiner, graph = self.joiner, self.joiner.graph
        checkpoint = joiner.checkpoint()
        before = joiner.totals()
        offered = [*graph.links, *links]
        if rivals:
            graph.replace_links([link for link in graph.links if not any(link is k for k in rivals)])
        for link in links:
            graph.add_link(link)
        joiner.batch(newest)
        self._clean(newest)
        verdict = self._verdict(links, offered, newest)
        if not self._is_better(verdict, before, newest) or (links and not verdict.believed):
            joiner.restore(checkpoint)
            return None
        return verdict

    def _is_better(self, verdict: Verdict, before: tuple[float, int], newest: int) -> bool:
        """Whether chi2 has risen no more than true matches make it rise, or fallen by more than the loss of true
        matches makes it fall. ``before``: chi2 and redundancy.
        """
        cost, redundancy = self.joiner.totals()
        rise, dof = cost - before[0], redundancy - before[1]
        if not verdict.believed:
            return self._excess(-rise, -dof, newest) > 0.0
        # Closures that contradict the covariances, but not the drift to expect, bend the map once for all of them.
        tension = max(k.tension for k in verdict.believed)
        outweighed = self._support(verdict.revoked) <= self._support(verdict.believed)
        return outweighed and self._excess((rise - tension) / self.config.view_change, dof, newest) <= 0.0

    def _clean(self, newest: int) -> None:
        """Take back what the joined map contradicts, until nothing is left or it has been asked often enough."""
        for _ in range(self.config.rounds):
            if not self._take_back(newest):
                break

    def _verdict(self, links: list[Link], offered: list[Link], newest: int) -> Verdict:
        """What became of ``offered``, all links there were, of which ``links`` are new."""
        graph, new = self.joiner.graph, _names(links)
        self.joiner.forget_stale(newest)
        before, after = {id(k) for k in offered}, {id(k) for k in graph.links}
        gone = [k for k in offered if id(k) not in after]
        smaller = [k for k in graph.links if id(k) not in before]
        believed = [k for k in links if id(k) in after] + [k for k in smaller if _name(k) in new]
        kept = _names(smaller) | new
        revoked = tuple(k for k in gone if k.is_closure and _name(k) not in kept)
        return Verdict(tuple(believed), _matches(gone) - _matches(smaller), revoked)

    def _excess(self, rise: float, dof: int, newest: int) -> float:
        """How far chi2 rose above what true matches explain. Submaps that are too sure of themselves make every
        closure look bad: the bound is in units of the map's own variance factor (Baarda 1968), never below one.
        """
        component = self.joiner.graph.component(newest)
        redundancy = max(self.joiner.redundancy(component), 1)
        factor = (self.joiner.cost(component) - max(rise, 0.0)) / redundancy
        factor = min(max(1.0, factor), self.config.max_variance_factor)
        return float(rise - factor * chi_square_bound(self.config.closure_probability, max(dof, 1)))

    def _take_back(self, newest: int) -> bool:
        """Take back what the joined component of a record contradicts most, and join it anew; whether there was any."""
        graph = self.joiner.graph
        component = graph.component(newest)
        nis = self._nis(component)
        seen = nis[np.isfinite(nis)]
        factor = min(variance_factor(seen), self.config.max_variance_factor)
        gate = factor * chi_square_bound(self.config.outlier_probability, 3)
        beyond = np.nonzero(nis > gate)[0]
        if not len(beyond):
            return False
        suspects = set(graph.record_of[beyond].tolist())
        strain = [
            (self._strain(k, nis), i) for i, k in enumerate(graph.links)
            if k.is_closure and (k.first in suspects or k.second in suspects)
        ]  # fmt: skip
        worst = max(strain, default=(0.0, 0), key=lambda entry: entry[0])
        if worst[0] > gate:
            graph.replace_links([link for i, link in enumerate(graph.links) if i != worst[1]])
            self.joiner.batch(newest)
            return True
        outliers = self._outliers(sorted(suspects), nis, gate)
        kept = [
            without(graph, k, outliers) if k.first in suspects or k.second in suspects else k for k in graph.links
        ]  # fmt: skip
        graph.replace_links([link for link in kept if link is not None])
        self.joiner.batch(newest)
        return True

    def _nis(self, component: int) -> FloatArray:
        """Squared error of every observation as the rest of its submap predicts it, NaN where no other submap sees
        it; (observations,), 3 degrees of freedom each.
        """
        graph, assembled = self.joiner.graph, self.joiner.opened(component)
        out = np.full(len(graph.points), np.nan)
        shared = graph.shared()
        for i, reduced in zip(assembled.records, assembled.reduced, strict=True):
            record = graph.records[i]
            rows = record.observations[reduced.shared]
            values = observation_nis(local_residual(graph, record, reduced), reduced.information)
            out[rows] = np.where(shared[rows], values, np.nan)
        return out

    def _strain(self, link: Link, nis: FloatArray) -> float:
        """Median squared error of a link's matches; the worse of its two submaps."""
        graph = self.joiner.graph
        sides = [
            nis[graph.records[record].first_observation + link.pairs[:, k]]
            for k, record in enumerate((link.first, link.second))
        ]
        return max((float(np.median(s[np.isfinite(s)])) for s in sides if np.isfinite(s).any()), default=0.0)

    def _outliers(self, records: Sequence[int], nis: FloatArray, gate: float) -> set[int]:
        """The worst observations of each record, where they are beyond the gate."""
        out: set[int] = set()
        for i in records:
            rows = self.joiner.graph.records[i].observations
            values = np.nan_to_num(nis[rows])
            allowed = max(1, int(self.config.outlier_share * np.isfinite(nis[rows]).sum()))
            worst = np.argsort(values)[::-1][:allowed]
            out.update(rows[worst[values[worst] > gate]].tolist())
        return out


def _matches(links: Sequence[Link]) -> int:
    return sum(len(link.pairs) for link in links)


def _name(link: Link) -> tuple[int, int, bool]:
    return link.first, link.second, link.is_closure


def _names(links: Sequence[Link]) -> set[tuple[int, int, bool]]:
    return {_name(link) for link in links}
