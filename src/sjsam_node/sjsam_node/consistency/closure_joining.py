# SPDX-License-Identifier: Apache-2.0
"""Joins closures to the map: tries a state with them, and accepts it where the tests of consistency do.

A submap's closures cost one update, and ``rounds`` more where something is removed; what is left is evaluated again
with the next ones, and when the map settles. Refused closures wait: a false one stands alone, true ones add up until
they outweigh it. A state that was tried in vain is dropped, and leaves nothing behind.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from sjsam_node.consistency.conditions import (
    JOINING_ROUNDS,
    MAX_REFUSED_CLOSURES,
    RETRY_GROWTH,
    SETTLING_ROUNDS,
    ConsistencyConfig,
    Verdict,
    is_among,
    verdict_on,
)
from sjsam_node.consistency.map_test import MapTest
from sjsam_node.consistency.overconfidence import OverconfidenceTest, links_of, reduced_chi2
from sjsam_node.consistency.pairwise import PairwiseConsistency, support_of
from sjsam_node.graph.links import Link, Status
from sjsam_node.loop_closure.verification import LINKED_SUBMAPS, ClosureConfig
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.smoothing.solver import relinked, updated
from sjsam_node.smoothing.state import EstimateState


@dataclass
class ClosureJoiner:
    """Applies what the tests decide to the estimate; ``refused`` closures wait, oldest first."""

    estimate: MapEstimate
    config: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    drift: ClosureConfig = field(default_factory=ClosureConfig)
    refused: list[Link] = field(default_factory=list)
    _refused_support: int = 0

    def __post_init__(self) -> None:
        self.pairwise = PairwiseConsistency(self.config, self.drift)
        self.map_test = MapTest(self.config)
        self.overconfidence = OverconfidenceTest(self.config, LINKED_SUBMAPS)

    def join_closures(self, found: Sequence[Link], newest: int) -> Verdict:
        """Update the map with the closures that it can live with; the others wait.

        ``newest`` is the record whose component is optimised, with or without closures.
        """
        graph = self.estimate.graph
        against = self.pairwise.against_odometry(graph, found)
        found = [k for k, is_off in zip(found, against, strict=True) if not is_off]
        least = RETRY_GROWTH * self._refused_support
        choice = self.pairwise.selected(graph, found, self.refused, least)
        added, removed = choice.added, choice.removed
        self.defer_closures(k for k in found if not is_among(k, added))
        if not added and not removed:
            return self._without_closures(newest)
        sure = [k for k in found if k.status is Status.CONSISTENT]
        verdict = self._tried(added, removed, newest)
        if verdict is None and 0 < len(sure) < len(
            added
        ):  # one that the map was not sure of need not take others along
            self.defer_closures(k for k in added if not is_among(k, sure))
            verdict = self._tried(sure, [], newest)
        if verdict is not None:
            return verdict
        self.defer_closures(added)
        if len(added) > len(found):
            self._refused_support = support_of(graph, added)
        return self._without_closures(newest)

    def remove_contradicted(self, newest: int) -> Verdict:
        """Remove what the settled map contradicts, until nothing is left or it has been evaluated often enough.

        Without a closure there is nothing that could be false but the filter's own submaps: these are left as they are.
        """
        before = self.estimate.state
        if not any(k.is_closure for k in before.graph.links):
            return Verdict()
        after, _ = self._without_contradictions(before, newest, SETTLING_ROUNDS)
        self.estimate.accept(after)
        return verdict_on([], before.graph.links, after.graph.links)

    def resolve_overconfidence(self) -> Verdict:
        """Treat parts whose submaps contradict each other (see :mod:`sjsam_node.consistency.overconfidence`)."""
        offered, test = self.estimate.graph.links, self.overconfidence
        records = test.overconfident_records(self.estimate.state)
        for record in records:
            self._keep_overconfidence(record)
        if records:
            self.estimate.optimize_full()
        for record in records:
            self._remove_conflicting(record)
        return verdict_on([], offered, self.estimate.graph.links)

    def _remove_conflicting(self, record: int) -> None:
        """Remove what the submaps of a record's component contradict, closures or the matches between neighbours."""
        for _ in range(SETTLING_ROUNDS):
            before, test = self.estimate.state, self.overconfidence
            if not test.is_overconfident(before, record):
                return
            if suspects := test.suspects(before, record):
                after = updated(before, record, [], suspects, self.estimate.config)
                if test.helps(before, after, record):
                    self.estimate.accept(after)
                    continue
            positions = before.graph.is_position
            neighbours = [k for k in links_of(before, record) if not (k.is_closure or positions[k.second])]
            self._keep_overconfidence(record)
            if neighbours:
                self.estimate.accept(updated(self.estimate.state, record, [], neighbours, self.estimate.config))
            return

    def _keep_overconfidence(self, record: int) -> None:
        self.estimate.add_overconfidence(record, reduced_chi2(self.estimate.state, record))

    def _without_closures(self, newest: int) -> Verdict:
        self.estimate.accept(updated(self.estimate.state, newest, [], [], self.estimate.config))
        return Verdict()

    def _tried(self, added: list[Link], removed: list[Link], newest: int) -> Verdict | None:
        """Update the map with closures and without others; None, and all as it was, if it cannot live with that."""
        before = self.estimate.state
        after = updated(before, newest, added, removed, self.estimate.config)
        after, chi2_fall = self._without_contradictions(after, newest, JOINING_ROUNDS)
        verdict = verdict_on(added, [*before.graph.links, *added], after.graph.links)
        if not self.map_test.accepts(before, after, verdict, newest, chi2_fall):
            return None
        self.estimate.accept(after)
        self.refused = [k for k in self.refused if not is_among(k, added)]
        self._refused_support = 0
        return verdict

    def _without_contradictions(self, state: EstimateState, newest: int, rounds: int) -> tuple[EstimateState, float]:
        """The state without what it contradicts: whole closures with an update each, single matches with the next.

        Also returns by how much chi2 will fall without these matches.
        """
        found = self.map_test.contradictions(state, newest)
        while rounds and found.closure is not None:
            state, rounds = updated(state, newest, [], [found.closure], self.estimate.config), rounds - 1
            found = self.map_test.contradictions(state, newest)
        trimming = self.map_test.trimming(state, found)
        if trimming.removed:
            state = relinked(state, trimming.removed, trimming.smaller, self.estimate.config)
        return state, trimming.chi2_fall

    def defer_closures(self, links: Iterable[Link]) -> None:
        """Let closures wait until more speaks for them."""
        known = {k.ends for k in self.refused}
        waiting = [k.with_status(Status.INCONSISTENT) for k in links if k.ends not in known]
        self.refused = [*self.refused, *waiting][-MAX_REFUSED_CLOSURES:]


def grouped(found: Sequence[Link], size: int) -> list[list[Link]]:
    """Links in groups of a ``size``, so that a false one takes few true ones with it.

    Those that the map finds consistent come first, by themselves, and exclude nothing that it holds.
    """
    consistent = [k for k in found if k.status is Status.CONSISTENT]
    others = [k for k in found if k.status is not Status.CONSISTENT]
    return [links[i : i + size] for links in (consistent, others) for i in range(0, len(links), size)]
