# SPDX-License-Identifier: Apache-2.0
"""Robust joining: rows of local maps that contradict all others lose their weight, and then their say.

A *row* is one pose or landmark of a local map; those in question are the ones that close something, because an older
map has seen the same. Joining with a robust loss is done by reweighting (Holland and Welsch 1977), from a loss that is
nearly quadratic to the wanted one (graduated non-convexity, Blake and Zisserman 1987), so that one false closure does
not bend the map while it is judged. A row counts less by a larger covariance; in a joint Gaussian, to scale the
information instead would make the other rows too sure.

What is reported in the end is no weighted compromise: rows beyond the bound are dropped, all others have their full
weight, and chi2 and covariances are those of the maps without the dropped rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sjsam_node.joint_problem.problem import JoiningState, LocalMap
from slam_core.config import Config, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray

LOSSES = ("none", "huber", "cauchy", "dcs")
_STEPS = 8
"""Rounds in which the bound of the loss is narrowed to the wanted one."""
_SETTLING = 3
"""Rounds with the wanted bound."""

Residual = Callable[[LocalMap, JoiningState], FloatArray]
Solve = Callable[[list[LocalMap], JoiningState], JoiningState]
_KEPT_SHARE = 0.9999
"""Share of true rows that are kept; their bound is the scale of the loss."""


@dataclass(frozen=True)
class RobustConfig(Config):
    """Treatment of closures that the rest of the map contradicts."""

    loss: str = parameter("none", "loss of rows that close something", choices=LOSSES)


def weight(loss: str, nis: float, bound: float) -> float:
    """Weight of a row with squared normalised error ``nis``.

    1 up to the ``bound`` and falling with the root (Huber 1964), ``1 / (1 + nis / bound)`` (Cauchy), or dynamic
    covariance scaling (Agarwal et al. 2013).
    """
    if loss == "huber":
        return 1.0 if nis <= bound else float(np.sqrt(bound / nis))
    if loss == "cauchy":
        return 1.0 / (1.0 + nis / bound)
    if loss == "dcs":
        return min(1.0, 2.0 * bound / (bound + nis)) ** 2
    return 1.0


def closing_rows(maps: list[LocalMap], pose_size: int, landmark_size: int) -> list[list[IntArray]]:
    """For every map the scalar rows of each pose or landmark that a map before it has seen already, (k,) each.

    A pose that no map has seen yet is odometry, whatever comes later; so is what alone ties a map to those before it.
    """
    known_poses, known_landmarks, found = set[int](), set[int](), []
    for k, m in enumerate(maps):
        rows, at, tied = [], 0, k == 0 or m.reference in known_poses
        known_poses.add(int(m.reference))
        for known, ids, size in ((known_poses, m.poses, pose_size), (known_landmarks, m.landmarks, landmark_size)):
            for i in ids.tolist():
                if i in known and tied:
                    rows.append(np.arange(at, at + size))
                tied = tied or i in known
                known.add(i)
                at += size
        found.append(rows)
    return found


def normalized_error(information: FloatArray, residual: FloatArray, rows: IntArray) -> float:
    """Squared error of some rows as all the others of the map predict them; chi-square of ``len(rows)``."""
    cost_gradient = (information @ residual)[rows]
    return float(cost_gradient @ np.linalg.solve(information[np.ix_(rows, rows)], cost_gradient))


def widened(information: FloatArray, rows: IntArray, factor: float) -> FloatArray:
    """The information matrix after the error of ``rows``, given the others, has become ``1 / factor`` as variable.

    By the matrix inversion lemma: with ``C = (1 / factor - 1) A_rr^-1`` added to the rows' covariance, the information
    loses ``(1 - factor) A_:r A_rr^-1 A_r:``; at factor 0 the rows are marginalised out.
    """
    columns = information[:, rows]
    return np.asarray(
        information - (1.0 - factor) * columns @ np.linalg.solve(information[np.ix_(rows, rows)], columns.T)
    )


@dataclass(frozen=True, eq=False)
class RobustResult:
    """A state, the maps that it was found with, and what was dropped.

    The maps have full weight but lack the dropped rows; the scalar rows dropped of each map, and how many poses and
    landmarks these are.
    """

    state: JoiningState
    maps: list[LocalMap]
    dropped: list[IntArray]
    count: int


class RobustJoining:
    """Reweights ``maps`` until their closing ``rows`` agree, then decides which to drop.

    ``residual`` is the error of a map at a state; ``solve`` joins maps from a state.
    """

    def __init__(
        self, maps: list[LocalMap], rows: list[list[IntArray]], residual: Residual, solve: Solve, config: RobustConfig
    ) -> None:
        self.maps, self.rows, self.config = maps, rows, config
        self._residual, self._solve = residual, solve

    def run(self, state: JoiningState) -> RobustResult:
        """From the state that plain least squares found."""
        worst = max(self._worst(state), 1.0)
        schedule = worst ** (1.0 - np.arange(1, _STEPS + 1) / _STEPS)
        for excess in [*schedule.tolist(), *[1.0] * _SETTLING] if worst > 1.0 else []:
            state = self._solve([self._weighted(k, state, excess) for k in range(len(self.maps))], state)
        decided = [self._decided(k, state) for k in range(len(self.maps))]
        kept, dropped = [m for m, _ in decided], [rows for _, rows in decided]
        count = sum(np.isin(r[0], gone) for rows, gone in zip(self.rows, dropped, strict=True) for r in rows)
        return RobustResult(self._solve(kept, state), kept, dropped, int(count))

    def _bound(self, dof: int) -> float:
        return chi_square_bound(_KEPT_SHARE, dof)

    def _worst(self, state: JoiningState) -> float:
        """Largest error of any closing row, in units of its bound."""
        worst = 0.0
        for m, rows in zip(self.maps, self.rows, strict=True):
            residual = self._residual(m, state) if rows else np.empty(0)
            for r in [*rows, np.concatenate(rows)] if rows else []:
                worst = max(worst, normalized_error(m.information, residual, r) / self._bound(len(r)))
        return worst

    def _weighted(self, k: int, state: JoiningState, excess: float) -> LocalMap:
        """A map whose closing rows have the weights of the loss, its bound ``excess`` times as wide.

        First each row, then all of them together, which may agree among themselves and be wrong.
        """
        if not self.rows[k]:
            return self.maps[k]
        residual, information = self._residual(self.maps[k], state), self.maps[k].information
        for rows in [*self.rows[k], np.concatenate(self.rows[k])]:
            w = weight(self.config.loss, normalized_error(information, residual, rows), excess * self._bound(len(rows)))
            if w < 1.0:
                information = widened(information, rows, w)
        return replace(self.maps[k], information=0.5 * (information + information.T))

    def _decided(self, k: int, state: JoiningState) -> tuple[LocalMap, IntArray]:
        """A map without the rows that are beyond their bound, worst first, and these rows."""
        m, left, dropped = self.maps[k], list(self.rows[k]), [np.empty(0, dtype=np.int64)]
        information, residual = m.information, self._residual(m, state)
        while left:
            excess = [normalized_error(information, residual, r) / self._bound(len(r)) for r in left]
            worst, together = int(np.argmax(excess)), np.concatenate(left)
            if excess[worst] <= 1.0 and normalized_error(information, residual, together) <= self._bound(len(together)):
                break
            dropped.append(left.pop(worst))
            information = _without(information, dropped[-1])
        return replace(m, information=information), np.concatenate(dropped)


def _without(information: FloatArray, rows: IntArray) -> FloatArray:
    out = widened(information, rows, 0.0)
    out[rows], out[:, rows] = 0.0, 0.0
    return 0.5 * (out + out.T)


def predicted(information: FloatArray, residual: FloatArray, rows: IntArray) -> FloatArray:
    """The residual of a map with that of some rows replaced by what the other rows predict for them."""
    if not len(rows):
        return residual
    others = np.setdiff1d(np.arange(len(residual)), rows)
    out = residual.copy()
    out[rows] = -np.linalg.solve(information[np.ix_(rows, rows)], information[np.ix_(rows, others)] @ residual[others])
    return out
