# SPDX-License-Identifier: Apache-2.0
"""Parts of the map whose submaps contradict each other by more than they may, whatever closures are held.

Such a part is optimised with few of the landmarks that its submaps share, and keeps the variance factor that all of
them had. If the submaps contradict each other still, closures are removed, the worst ones first, if that helps. If it
does not, the matches between neighbours are: the filter's own chain of submaps stays. Closures without which the part
falls apart are kept: of two maps that nothing else ties neither can contradict the other any more, so that their
removal always helps and says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sjsam_node.consistency.conditions import ConsistencyConfig
from sjsam_node.consistency.map_test import worst_closures
from sjsam_node.graph.links import Link
from sjsam_node.smoothing.state import EstimateState

_RELIEF = 0.5
"""Share of the reduced chi2 that may be left for closures to have been its cause."""


@dataclass(frozen=True)
class OverconfidenceTest:
    """Judges whether submaps are too sure of themselves; ``window``: how many submaps a stretch of way has."""

    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    window: int = 4

    def overconfident_records(self, state: EstimateState) -> list[int]:
        """One record of each component whose submaps contradict each other too much."""
        return [state.records_in(c)[0] for c in state.components() if self._is_over(state, c)]

    def is_overconfident(self, state: EstimateState, record: int) -> bool:
        """True if the component of a record is one of them."""
        return self._is_over(state, state.component(record))

    def suspects(self, state: EstimateState, record: int) -> list[Link]:
        """The closures of a record's component that are contradicted most."""
        closures = [k for k in links_of(state, record) if k.is_closure]
        return worst_closures(state, closures, state.component(record), self.window)

    def helps(self, before: EstimateState, after: EstimateState, record: int) -> bool:
        """True if what was removed between two states was the cause of the contradictions, and ties nothing alone."""
        is_whole = len(after.components()) == len(before.components())
        return is_whole and reduced_chi2(after, record) <= _RELIEF * reduced_chi2(before, record)

    def _is_over(self, state: EstimateState, component: int) -> bool:
        return state.result(component).reduced_chi2 > self.config.max_variance_factor


def links_of(state: EstimateState, record: int) -> list[Link]:
    """Links inside a record's component."""
    return [k for k in state.graph.links if state.component(k.first) == state.component(record)]


def reduced_chi2(state: EstimateState, record: int) -> float:
    """chi2 per degree of freedom of a record's component."""
    return state.result(state.component(record)).reduced_chi2
