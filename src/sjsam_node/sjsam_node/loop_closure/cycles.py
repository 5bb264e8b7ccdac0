# SPDX-License-Identifier: Apache-2.0
"""Cycles of links that wait, closed by what the map knows between their ends.

A false link leads anywhere in the space in which its two submaps could overlap. That a cycle through it closes all the
same, within what links and map claim, is improbable by the share of that space that the claim leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse.csgraph import dijkstra

from sjsam_node.graph.links import Link, Prior
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus, compose_covariance

Hop = Callable[[int, int], Prior | None]
"""T_a_b of the starts of two records by the map, None where it does not tie them."""
_NONE = -9999
"""Predecessor, by SciPy, of what no path leads to."""


@dataclass(frozen=True, eq=False)
class Cycle:
    """Links one after the other, and the pose (4, 4) with covariance (6, 6) to which they and the map lead back."""

    links: tuple[Link, ...]
    T: FloatArray
    covariance: FloatArray

    def closes(self, probability: float) -> bool:
        """True if it leads back to where it began, within the gate of a share of true cycles."""
        error = boxminus(self.T, np.eye(4))
        return bool(error @ np.linalg.solve(self.covariance, error) <= chi_square_bound(probability, 6))

    def chance(self, probability: float, reach: float) -> float:
        """Chance that it closes with a false link, whose submaps can overlap where they are ``reach`` (m) apart.

        False alignments share the vertical and the height of the floor more often than not: of the gate two of three
        directions count, and one of three angles.
        """
        bound = chi_square_bound(probability, 6)
        gate = np.sqrt(bound * np.linalg.eigvalsh(self.covariance[:3, :3])[1:]) / reach
        angle = np.sqrt(bound * np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]) / np.pi
        return float(np.minimum([*gate, angle], 1.0).prod())


def cycles_through(link: Link, others: Sequence[Link], hop: Hop) -> Iterator[Cycle]:
    """The surest cycles, of any length, through a link and each other one after which it can end (Dijkstra 1959)."""
    steps = [link, *others, *(k.inverted() for k in others)]
    variance = np.full((len(steps), len(steps)), np.inf)
    for i, before in enumerate(steps):
        for j, after in enumerate(steps[1:], start=1):
            way = hop(before.second, after.first)
            if way is not None:
                variance[i, j] = _position_variance(way) + np.trace(after.covariance[:3, :3])
    before_it = dijkstra(np.where(np.isinf(variance), 0.0, variance), indices=0, return_predecessors=True)[1]
    for last in range(1, len(steps)):
        path = [last]
        while path[0] > 0 and before_it[path[0]] != _NONE:
            path.insert(0, int(before_it[path[0]]))
        links = [steps[k] for k in path]
        is_simple = path[0] == 0 and len({frozenset(k.ends) for k in links}) == len(links)
        if is_simple and hop(links[-1].second, link.first) is not None:
            yield _cycle(links, hop)


def _cycle(links: list[Link], hop: Hop) -> Cycle:
    """The cycle of links, between which the map leads on."""
    T, covariance = links[0].T, links[0].covariance
    for before, after in pairwise([*links, links[0]]):
        T, covariance = _followed(T, covariance, hop(before.second, after.first))
        if after is not links[0]:
            T, covariance = _followed(T, covariance, Prior(after.T, after.covariance))
    return Cycle(tuple(links), T, covariance)


def _position_variance(step: Prior) -> float:
    """Sum of the variances of a position, m2; above zero."""
    return 1e-12 + (0.0 if step.covariance is None else float(np.trace(step.covariance[:3, :3])))


def _followed(T: FloatArray, covariance: FloatArray, step: Prior | None) -> tuple[FloatArray, FloatArray]:
    """A pose with covariance after one more step."""
    assert step is not None
    known = np.zeros((6, 6)) if step.covariance is None else step.covariance
    return np.asarray(T @ step.T), compose_covariance(T, covariance, step.T, known)
