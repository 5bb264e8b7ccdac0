# SPDX-License-Identifier: Apache-2.0
"""Joint compatibility branch and bound (Neira and Tardos 2001): the largest set of pairs that fit together.

A pair may pass its own gate and yet contradict the others: their errors share the error of the pose. The joint test
uses that correlation, branch and bound searches the interpretations that pass it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray

IndexArray = npt.NDArray[np.int64]
UNPAIRED = -1


@dataclass(frozen=True, eq=False)
class JointPrediction:
    """Joint prediction of the measurements of L landmarks.

    ``z`` (L, d) and the joint covariance ``H P H'`` (L d, L d), correlations included.
    """

    z: FloatArray
    covariance: FloatArray


def jcbb(
    measured: FloatArray,
    noise: FloatArray,
    predicted: JointPrediction,
    *,
    angles: tuple[int, ...] = (),
    confidence: float = 0.99,
    max_nodes: int = 20_000,
) -> IndexArray:
    """Landmark of each measurement, or -1.

    Parameters
    ----------
    measured
        (M, d).
    noise
        (M, d, d) covariances.
    predicted
        Of the landmarks.
    angles
        Columns that are angles (rad), whose differences are wrapped.
    confidence
        Of the individual and of the joint chi-square test.
    max_nodes
        Branches looked at before the best interpretation so far is taken.
    """
    search = _Search(measured, noise, predicted, angles, confidence, max_nodes)
    search.run()
    return search.best


class _Search:
    """Depth-first search; a node is the pairs so far with the Cholesky factor of their joint covariance."""

    def __init__(
        self,
        measured: FloatArray,
        noise: FloatArray,
        predicted: JointPrediction,
        angles: tuple[int, ...],
        confidence: float,
        max_nodes: int,
    ) -> None:
        self._count, self._dim = measured.shape
        self._noise = noise
        self._covariance = predicted.covariance
        self._nodes_left = max_nodes
        self._innovation = measured[:, None, :] - predicted.z[None]
        for column in angles:
            wrapped = self._innovation[:, :, column]
            self._innovation[:, :, column] = (wrapped + np.pi) % (2.0 * np.pi) - np.pi
        self._gates = np.array([chi_square_bound(confidence, self._dim * k) for k in range(1, self._count + 1)])
        self._candidates = [self._compatible(i) for i in range(self._count)]
        # Few choices first: wrong branches end early.
        self._order = sorted(range(self._count), key=lambda i: (len(self._candidates[i]) or self._count + 1, i))
        self.best = np.full(self._count, UNPAIRED, dtype=np.int64)
        self._best_size, self._best_nis = 0, np.inf

    def run(self) -> None:
        """Search everything, or as much as ``max_nodes`` allow."""
        self._branch(0, [], np.zeros((0, 0)), np.zeros(0))

    def _compatible(self, i: int) -> list[int]:
        """Landmarks whose individual test measurement i passes, nearest first."""
        landmarks = np.arange(self._innovation.shape[1])
        rows = self._dim * landmarks[:, None] + np.arange(self._dim)
        S = self._covariance[rows[:, :, None], rows[:, None, :]] + self._noise[i]
        innovation = self._innovation[i]
        nis = np.einsum("ld,ld->l", innovation, np.linalg.solve(S, innovation[:, :, None])[:, :, 0])
        return [int(j) for j in np.argsort(nis) if nis[j] < self._gates[0]]

    def _branch(self, depth: int, pairs: list[tuple[int, int]], factor: FloatArray, whitened: FloatArray) -> None:
        if len(pairs) + sum(bool(self._candidates[i]) for i in self._order[depth:]) < self._best_size:
            return
        nis = float(whitened @ whitened)
        if (len(pairs), -nis) > (self._best_size, -self._best_nis):
            self._accept(pairs, nis)
        if depth == self._count or self._nodes_left <= 0:
            return
        i, taken = self._order[depth], {j for _, j in pairs}
        for j in self._candidates[i]:
            if j not in taken:
                self._nodes_left -= 1
                self._try(depth, pairs, factor, whitened, i, j)
        self._branch(depth + 1, pairs, factor, whitened)

    def _try(
        self, depth: int, pairs: list[tuple[int, int]], factor: FloatArray, whitened: FloatArray, i: int, j: int
    ) -> None:
        """Extend the joint test by one pair, and the search below it if it passes."""
        d, n = self._dim, len(whitened)
        own = slice(d * j, d * j + d)
        S = self._covariance[own, own] + self._noise[i]
        columns = [self._covariance[d * k : d * k + d, own] for _, k in pairs]
        cross = np.vstack(columns) if columns else np.zeros((0, d))
        side = solve_triangular(factor, cross, lower=True) if n else cross
        try:
            corner = np.linalg.cholesky(S - side.T @ side)
        except np.linalg.LinAlgError:
            return
        own_whitened = solve_triangular(corner, self._innovation[i, j] - side.T @ whitened, lower=True)
        extended = np.concatenate([whitened, own_whitened])
        if extended @ extended < self._gates[len(pairs)]:
            grown = np.block([[factor, np.zeros((n, d))], [side.T, corner]])
            self._branch(depth + 1, [*pairs, (i, j)], grown, extended)

    def _accept(self, pairs: list[tuple[int, int]], nis: float) -> None:
        self._best_size, self._best_nis = len(pairs), nis
        self.best = np.full(self._count, UNPAIRED, dtype=np.int64)
        for i, j in pairs:
            self.best[i] = j
