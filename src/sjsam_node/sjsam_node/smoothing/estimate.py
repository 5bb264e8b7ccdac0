# SPDX-License-Identifier: Apache-2.0
"""Holds the state of the map: nobody else says which one it is.

    estimate.accept(updated(estimate.state, newest, added, removed, estimate.config))
    T_prior = estimate.relative_pose(first, second)

What is read comes from the last update's factor, and is as fresh as that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sjsam_node.graph.links import Link, Prior
from sjsam_node.graph.map_graph import ALL, MapGraph, Record
from sjsam_node.regions.tasks import InProcess, Tasks
from sjsam_node.smoothing.condensing import condense
from sjsam_node.smoothing.marginals import prior_of_pair, relative_pose, seen_from
from sjsam_node.smoothing.solver import Optimize, SmootherConfig, optimize_full, relinearized, simplified
from sjsam_node.smoothing.state import EstimateState, with_links, with_submap
from sjsam_node.smoothing.submap_joining import Eliminating, Elimination, Marginal, marginal
from slam_core.geometry import FloatArray, compose_covariance
from slam_core.types import Submap


class MapEstimate:
    """The state that holds, and what replaces it.

    ``optimize``: what solves the whole map in the end instead of its own factor (:mod:`sjsam_node.regions`); ``tasks``:
    where old submaps are joined.
    """

    def __init__(
        self, config: SmootherConfig | None = None, state: EstimateState | None = None, tasks: Tasks | None = None
    ) -> None:
        self.config, self._tasks = config or SmootherConfig(), tasks or InProcess()
        self.optimize: Optimize | None = None
        self._state = state or EstimateState()

    @property
    def state(self) -> EstimateState:
        """The state that holds now."""
        return self._state

    @property
    def graph(self) -> MapGraph:
        """The facts that hold now."""
        return self._state.graph

    def accept(self, state: EstimateState) -> None:
        """Go on from a state that was made of the present one."""
        self._state = state

    def add_submap(self, submap: Submap, start: int | None, guess: FloatArray, budget: int = ALL) -> int:
        """Number of the record of a new submap at node ``start``, or at a ``guess`` (4, 4) in a component of its own.

        ``budget`` landmarks, at most, connect it to each other one.
        """
        self._state = with_submap(self._state, submap, start, guess, budget)
        return len(self.graph.records) - 1

    def add_links(self, links: Sequence[Link]) -> None:
        """Take links in; the next update optimises them."""
        self._state = with_links(self._state, links)

    def mark_redundant(self, record: int) -> None:
        """A record shows nothing new."""
        redundant = self._state.redundant.copy()
        redundant[record] = True
        self._state = replace(self._state, redundant=redundant)

    def add_overconfidence(self, record: int, factor: float) -> None:
        """The submaps of a record's component contradict each other by a variance ``factor``."""
        overconfidence, state = self._state.overconfidence.copy(), self._state
        records = state.records_in(state.component(record))
        overconfidence[records] = np.maximum(overconfidence[records], factor)
        self._state = replace(state, overconfidence=overconfidence)

    def replace_record(self, number: int, record: Record) -> None:
        """A record that says the same as the one there, its arrays elsewhere."""
        self._state = replace(self._state, graph=self.graph.with_record(number, record))

    @contextmanager
    def condensing(self, new: int, busy: Sequence[int]) -> Iterator[None]:
        """Join old submaps that nothing touches, and freeze redundant ones; ``busy`` records stay as they are.

        Meanwhile links may be looked for, which needs nothing of that, but the state must stay.
        """
        if not self.config.estimator.linearises:
            yield
            return
        before, region = self._state, self.config.region
        work = condense(before, region, self.config.estimator.rows, new, busy)
        found = _sent(work, None)
        handle = None if isinstance(found, EstimateState) else self._tasks.submit(marginal, found)
        yield
        while not isinstance(found, EstimateState):
            found = _sent(work, *self._tasks.gather([handle]))
            if not isinstance(found, EstimateState):
                handle = self._tasks.submit(marginal, found)
        if self._state is not before:
            raise RuntimeError("the map was changed while old submaps were joined")
        self._state = found

    def optimize_full(self, *, coarse: bool = False) -> None:
        """All at its optimum, with every submap on its own and all shared landmarks, where that is affordable.

        And where they do not contradict each other: then fewer say more. ``coarse``: as near to it as an update does.
        """
        self._state = simplified(self._state, self.config)  # the problem and factor of before are as large as the new
        optimize = None if coarse else self.optimize
        self._state = optimize_full(self._state, self.config, coarse=coarse, optimize=optimize)

    def relinearize(self) -> None:
        """Keep nothing but the graph and its estimate, which is at its optimum: after loading as after saving."""
        self.release_factors()
        self._state = relinearized(self._state, self.config)

    def release_factors(self) -> None:
        """Keep nothing of what was solved; no covariance can be asked for until the next update."""
        self._state = replace(self._state, solved={}, reduced={}, recovered={})

    def relative_pose(self, first: int, second: int) -> Prior | None:
        """Estimate of T_first_second (starts of two records, the second one the newer).

        None across components. What the last factor does not hold counts with its odometry alone, which is never too
        sure.
        """
        state, component = self._state, self._state.component(first)
        if component != state.component(second):
            return None
        first_node, T_first, first_covariance = _anchored(state, component, first)
        node, T, covariance = _anchored(state, component, second)
        if first_node is None or node is None:
            return None
        joint = state.problem(component).covariance([first_node, node])
        T_known, known = relative_pose(state.poses[first_node], state.poses[node], joint)
        T_node, T_covariance = T_known @ T, compose_covariance(T_known, known, T, covariance)
        return prior_of_pair(*seen_from(T_first, first_covariance, T_node, T_covariance))


def _sent(work: Eliminating[EstimateState], result: Marginal | None) -> Elimination | EstimateState:
    """The elimination that some work asks for next, or what comes of it."""
    try:
        return work.send(result)
    except StopIteration as end:
        state: EstimateState = end.value
        return state


def _anchored(state: EstimateState, component: int, record: int) -> tuple[int | None, FloatArray, FloatArray]:
    """The last node before a record's start that the last factor holds, and the way from there."""
    graph, problem = state.graph, state.problem(component)
    node, T, covariance = graph.records[record].start, np.eye(4), np.zeros((6, 6))
    while node not in problem.nodes:
        found = problem.moving_with(node)
        if found is not None:
            reference, T_node, own = found
            return reference, T_node @ T, compose_covariance(T_node, own, T, covariance)
        before = graph.record_ending_at(node)
        if before is None:
            return None, T, covariance
        submap = graph.records[before].submap
        covariance = compose_covariance(submap.end_pose, submap.covariance[:6, :6], T, covariance)
        T = submap.end_pose @ T
        node = graph.records[before].start
    return node, T, covariance
