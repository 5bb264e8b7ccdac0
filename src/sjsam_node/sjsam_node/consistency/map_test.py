# SPDX-License-Identifier: Apache-2.0
"""The joined map's own test of what it holds: closures and matches that disagree with it, new ones as a whole.

A closure whose landmarks disagree with the map on the whole is contradicted, and so are single matches that stand out.
True matches raise chi2 by no more than noise explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.consistency.conditions import (
    CLOSURE_PROBABILITY,
    OUTLIER_PROBABILITY,
    OUTLIER_SHARE,
    VIEW_CHANGE_FACTOR,
    ConsistencyConfig,
    Verdict,
)
from sjsam_node.consistency.pairwise import support_of
from sjsam_node.graph.links import Link
from sjsam_node.loop_closure.association import variance_factor
from sjsam_node.smoothing.state import EstimateState
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.sparse_cholesky import IntArray


@dataclass(frozen=True, eq=False)
class Contradictions:
    """The closure that the map contradicts most, or None; and the observations (n,) beyond the gate, of ``nis``."""

    closure: Link | None
    outliers: IntArray
    nis: FloatArray


@dataclass(frozen=True, eq=False)
class Trimming:
    """Links to replace by others with fewer matches, and by how much chi2 will fall without these."""

    removed: list[Link] = field(default_factory=list)
    smaller: list[Link] = field(default_factory=list)
    chi2_fall: float = 0.0


@dataclass(frozen=True)
class MapTest:
    """Judges a state of the map."""

    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)

    def contradictions(self, state: EstimateState, newest: int) -> Contradictions:
        """Closures and matches that the component of record ``newest`` contradicts."""
        graph, nis = state.graph, nis_of(state, state.component(newest))
        gate = self._gate(nis)
        beyond = np.nonzero(np.nan_to_num(nis) > gate)[0]
        near = np.isin(graph.linked, graph.records_of(beyond)).any(axis=1)
        closures = [k for i in np.nonzero(near)[0].tolist() if (k := graph.links[i]).is_closure]
        worst = max(closures, key=lambda k: median_nis(state, k, nis), default=None)
        is_off = worst is not None and median_nis(state, worst, nis) > gate
        return Contradictions(worst if is_off else None, beyond, nis)

    def trimming(self, state: EstimateState, found: Contradictions) -> Trimming:
        """The links without the worst matches of each record of those that are contradicted.

        chi2 falls by the squared error of each landmark's worst observation.
        """
        graph, beyond, nis = state.graph, found.outliers, found.nis
        outliers: set[int] = set()
        record_of = graph.records_of(beyond)
        suspects = np.unique(record_of).tolist()
        for i in suspects:
            allowed = max(1, int(OUTLIER_SHARE * np.isfinite(nis[graph.records[i].observations]).sum()))
            own = beyond[record_of == i]
            outliers.update(own[np.argsort(-nis[own], kind="stable")[:allowed]].tolist())
        if not outliers:
            return Trimming()
        touched = [k for k in graph.links if not set(suspects).isdisjoint(k.ends)]
        smaller = [(k, _without(state, k, outliers)) for k in touched]
        rows = np.array(sorted(outliers))
        worst = np.zeros(len(nis))
        np.maximum.at(worst, graph.landmarks_at(rows), nis[rows])
        return Trimming(
            [k for k, s in smaller if s is not k], [s for k, s in smaller if s and s is not k], float(worst.sum())
        )

    def accepts(
        self, before: EstimateState, after: EstimateState, verdict: Verdict, newest: int, chi2_fall: float
    ) -> bool:
        """Tell whether chi2 has changed by no more than true matches make it change.

        It may rise by what true matches add, or fall by more than the loss of true matches makes it fall.
        ``chi2_fall``: by how much it will fall without matches that are removed already.
        """
        (cost, redundancy), (cost_before, redundancy_before) = after.totals(), before.totals()
        rise, dof = cost - cost_before - chi2_fall, redundancy - redundancy_before
        if not verdict.accepted:
            return bool(verdict.removed) and self._excess(after, -rise, -dof, newest) > 0.0
        # Closures that contradict the covariances, but not the drift to expect, move the map once for all of them.
        known = max(k.error for k in verdict.accepted)
        outweighed = support_of(after.graph, verdict.removed) <= support_of(after.graph, verdict.accepted)
        return outweighed and self._excess(after, (rise - known) / VIEW_CHANGE_FACTOR, dof, newest) <= 0.0

    def _excess(self, state: EstimateState, rise: float, dof: int, newest: int) -> float:
        """Rise of chi2 above what true matches explain.

        Submaps that are too sure of themselves make every closure look bad: the bound is in units of the map's own
        variance factor (Baarda 1968), never below one.
        """
        result = state.result(state.component(newest))
        factor = (result.cost - max(rise, 0.0)) / max(result.redundancy, 1)
        factor = min(max(1.0, factor), self.config.max_variance_factor)
        return float(rise - factor * chi_square_bound(CLOSURE_PROBABILITY, max(dof, 1)))

    def _gate(self, nis: FloatArray) -> float:
        """Squared error beyond which a match is none, in units of the map's own variance factor."""
        factor = min(variance_factor(nis[np.isfinite(nis)]), self.config.max_variance_factor)
        return factor * chi_square_bound(OUTLIER_PROBABILITY, 3)


def nis_of(state: EstimateState, component: int) -> FloatArray:
    """Squared error of every observation as the rest of its submap predicts it, NaN where it connects nothing.

    (observations,), 3 degrees of freedom each.
    """
    problem = state.problem(component)
    out = np.full(state.graph.observation_count, np.nan)
    out[problem.observations] = problem.nis()
    return out


def median_nis(state: EstimateState, link: Link, nis: FloatArray) -> float:
    """Median squared error of a link's matches; the worse of its two submaps."""
    records = state.graph.records
    sides = [nis[records[link.ends[k]].first_observation + link.pairs[:, k]] for k in (0, 1)]
    return max((float(np.median(s[np.isfinite(s)])) for s in sides if np.isfinite(s).any()), default=0.0)


def worst_closures(state: EstimateState, closures: Sequence[Link], component: int, window: int) -> list[Link]:
    """Closure that its landmarks contradict most, and others between the same two stretches of way."""
    if not closures:
        return []
    nis = nis_of(state, component)
    worst = max(closures, key=lambda k: median_nis(state, k, nis))
    near = np.abs(np.array([k.ends for k in closures]) - worst.ends).max(axis=1) <= window
    return [k for k, is_near in zip(closures, near, strict=True) if is_near]


def _without(state: EstimateState, link: Link, observations: set[int]) -> Link | None:
    """The link without pairs that name any of the observations; None for a closure with fewer than three left."""
    first = [state.graph.records[i].first_observation for i in link.ends]
    bad = np.isin(link.pairs + np.array(first), list(observations)).any(axis=1)
    if not bad.any():
        return link
    kept = link.pairs[~bad]
    return replace(link, pairs=kept) if len(kept) >= 3 or not link.is_closure else None
