# SPDX-License-Identifier: Apache-2.0
"""Matches the landmarks of two submaps (chapter 4, 7.5 and 9.4.1).

Three ways, weakest first: *nearest* neighbour within a Euclidean gate (Algorithm 1, as chapter 7 uses it),
*mahalanobis* with each pair's innovation covariance (Algorithm 2), *joint*, which in addition asks that all pairs
together agree with the joint covariance of both submaps (Neira and Tardos 2001) and drops the worst until they do.
All ask for similar descriptors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from sjsam_node.graph.links import Prior
from slam_core.config import Config, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxplus, skew, transform_points
from slam_core.linear_algebra import blas
from slam_core.linear_algebra.small_kernels import solved_square
from slam_core.linear_algebra.sparse_cholesky import IntArray

METHODS = ("nearest", "mahalanobis", "joint")

_JOINT_PAIRS = 64
"""Pairs that are tested together; where there are more, the others are tested against what these say."""
MAX_VARIANCE_FACTOR = 16.0
"""Submaps too sure of themselves by up to this factor are matched all the same."""

GATE_PROBABILITY = 0.999
"""Share of true pairs of landmarks inside the chi-square gate."""


@dataclass(frozen=True)
class AssociationConfig(Config):
    """Gates of the association between submaps."""

    method: str = parameter("joint", "how landmarks are matched", choices=METHODS)
    descriptor_threshold: float = 0.6
    """Least scalar product of two descriptors (7.5)."""
    nearest_gate: float = parameter(0.3, "distance below which the nearest neighbour is taken", unit="m", minimum=0.0)
    position_noise: float = 0.005
    """Standard deviation added to each landmark when gating: submaps are linearised (m)."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """Landmarks as seen from one frame: points (n, 3) m, joint covariance (3n, 3n), descriptors (n, d) of unit norm."""

    points: FloatArray
    covariance: FloatArray
    descriptors: npt.NDArray[np.float32]

    def select(self, index: IntArray) -> PointSet:
        """The landmarks at ``index`` with their joint covariance."""
        rows = (3 * index[:, None] + np.arange(3)).ravel()
        return PointSet(self.points[index], self.covariance[np.ix_(rows, rows)], self.descriptors[index])

    def at(self, index: IntArray) -> PointSet:
        """Landmarks at ``index``; without a copy where all are meant."""
        return self if len(index) == len(self.points) else self.select(index)

    def variances(self) -> FloatArray:
        """Covariance (n, 3, 3) of each landmark."""
        n, k = len(self.points), np.arange(len(self.points))
        return np.asarray(self.covariance.reshape(n, 3, n, 3)[k, :, k, :])


@dataclass(frozen=True, eq=False)
class Alignment:
    """Matched landmarks of two sets.

    Index pairs (k, 2), T_first_second with covariance, chi2 and its degrees of freedom.
    """

    pairs: IntArray
    T: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int


def similarity(first: PointSet, second: PointSet) -> npt.NDArray[np.float32]:
    """Scalar products of all descriptors (Eq. 3.1), shape (n, m)."""
    return np.asarray(first.descriptors @ second.descriptors.T)


def candidate_pairs(first: PointSet, second: PointSet, prior: Prior, config: AssociationConfig) -> IntArray:
    """One-to-one pairs (k, 2) inside the gate around the prior, each the other's best."""
    alike, seen = similarity(first, second) >= config.descriptor_threshold, transform_points(prior.T, second.points)
    if config.method == "nearest":
        i, j = np.nonzero(alike)
        distance = np.linalg.norm(first.points[i] - seen[j], axis=1)
        inside = distance < config.nearest_gate
        return mutual_best(i[inside], j[inside], distance[inside])
    own, other = first.variances() + config.position_noise**2 * np.eye(3), variances_seen(second, prior)
    return mutual_best(*_gated(alike, first.points, seen, own, other, chi_square_bound(GATE_PROBABILITY, 3)))


@njit(cache=True, nogil=True)
def _gated(alike, first, second, own, other, bound):  # type: ignore[no-untyped-def]
    """Pairs (i, j) of points inside the gate, and their scores ``NIS + log det`` (Eq. 4.8)."""
    most = int(alike.sum())
    i, j, score = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = 0
    e, S = np.empty(3), np.empty((3, 3))
    for a in range(len(first)):
        for b in range(len(second)):
            if not alike[a, b]:
                continue
            squared = trace = 0.0
            for p in range(3):
                e[p] = first[a, p] - second[b, p]
                squared += e[p] * e[p]
                trace += own[a, p, p] + other[b, p, p]
            if squared >= bound * trace:  # no eigenvalue is larger than the trace: this is outside the gate
                continue
            S[:] = own[a] + other[b]
            nis, log_det = solved_square(S, e)
            if nis < bound:
                i[count], j[count], score[count] = a, b, nis + log_det
                count += 1
    return i[:count], j[:count], score[:count]


def variances_seen(points: PointSet, prior: Prior) -> FloatArray:
    """Covariance (n, 3, 3) of each landmark as the prior places it."""
    R = prior.T[:3, :3]
    seen = R @ points.variances() @ R.T
    if prior.covariance is not None:
        J = _alignment_jacobian(prior.T, points.points).reshape(-1, 3, 6)
        seen = seen + J @ prior.covariance @ np.swapaxes(J, 1, 2)
    return np.asarray(seen)


def mutual_best(i: IntArray, j: IntArray, score: FloatArray) -> IntArray:
    """Pairs (k, 2) whose score is the least of both their row and their column."""
    if len(i) == 0:
        return np.empty((0, 2), dtype=np.int64)
    best_row, best_column = np.full(i.max() + 1, np.inf), np.full(j.max() + 1, np.inf)
    np.minimum.at(best_row, i, score)
    np.minimum.at(best_column, j, score)
    kept = (score == best_row[i]) & (score == best_column[j])
    pairs = np.stack([i[kept], j[kept]], axis=1)
    return np.asarray(pairs[np.unique(pairs[:, 0], return_index=True)[1]])


def match(first: PointSet, second: PointSet, prior: Prior, config: AssociationConfig) -> Alignment:
    """Match two sets around a prior with the configured method."""
    pairs = candidate_pairs(first, second, prior, config)
    if config.method == "joint":
        return jointly_compatible(first, second, pairs, prior, config)
    return align(first, second, pairs, prior, config)


def jointly_compatible(
    first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig
) -> Alignment:
    """The pairs that agree together with the joint covariance of both submaps.

    Of many pairs a sample is tested so, and the others, one by one, against the alignment that it gives.
    """
    if len(pairs) <= _JOINT_PAIRS:
        return _compatible(first, second, pairs, prior, config)[0]
    sample = np.linspace(0, len(pairs) - 1, _JOINT_PAIRS).astype(np.int64)
    found, scale = _compatible(first, second, pairs[sample], prior, config)
    others = np.delete(pairs, sample, axis=0)
    nis = nis_one_by_one(first, second, others, Prior(found.T, found.covariance), config)
    fitting = others[nis <= scale * chi_square_bound(GATE_PROBABILITY, 3)]
    kept = np.concatenate([found.pairs, fitting])
    return replace(found, pairs=kept[np.argsort(kept[:, 0], kind="stable")])


def _compatible(
    first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig
) -> tuple[Alignment, float]:
    """Pairs left when the worst are dropped until all agree, and how much too sure of themselves the submaps are."""
    scale = 1.0
    while True:
        solved = _solve(first, second, pairs, prior, config)
        scale = min(max(scale, variance_factor(solved.nis)), MAX_VARIANCE_FACTOR)
        bound = scale * chi_square_bound(GATE_PROBABILITY, max(solved.dof, 1))
        outlier = solved.nis > scale * chi_square_bound(GATE_PROBABILITY, 3)
        if len(pairs) == 0 or (solved.chi2 <= bound and not outlier.any()):
            return replace(solved.alignment(pairs), covariance=scale * solved.covariance), scale
        # Those that stand out together are dropped together, but never more than a tenth at once: bad ones spoil
        # good ones.
        count = max(1, min(int(outlier.sum()), len(pairs) // 10))
        pairs = np.delete(pairs, np.argsort(solved.nis)[-count:], axis=0)


def agreeing(first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig) -> Alignment:
    """Alignment by the pairs that are left when the worst is dropped until none stands out; none if all together do.

    Covariances and prior are believed as they are, unlike those of submaps.
    """
    while True:
        solved = _solve(first, second, pairs, prior, config)
        if len(pairs) and solved.nis.max() > chi_square_bound(GATE_PROBABILITY, 3):
            pairs = np.delete(pairs, int(np.argmax(solved.nis)), axis=0)
        elif solved.chi2 > chi_square_bound(GATE_PROBABILITY, max(solved.dof, 1)):
            pairs = pairs[:0]
        else:
            return solved.alignment(pairs)


def nis_one_by_one(
    first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig
) -> FloatArray:
    """Normalised squared error (n,) of each pair by itself, 3 degrees of freedom."""
    i, j = pairs[:, 0], pairs[:, 1]
    error = first.points[i] - transform_points(prior.T, second.points[j])
    own = first.variances()[i] + config.position_noise**2 * np.eye(3)
    S = own + variances_seen(second, prior)[j]
    return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(S, error[..., None])[..., 0]))


def variance_factor(nis: FloatArray) -> float:
    """Factor by which covariances are too small, from normalised squared errors of 3 degrees of freedom each.

    The median tells, so that false matches do not: where it is what it should be, or below, the factor is one.
    """
    return max(1.0, float(np.median(nis)) / chi_square_bound(0.5, 3)) if len(nis) >= 5 else 1.0


def align(first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig) -> Alignment:
    """Generalised least-squares alignment of given pairs, with the joint covariance of both sets."""
    return _solve(first, second, pairs, prior, config).alignment(pairs)


@dataclass(frozen=True, eq=False)
class _Solution:
    T: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    nis: FloatArray

    def alignment(self, pairs: IntArray) -> Alignment:
        return Alignment(pairs, self.T, self.covariance, self.chi2, self.dof)


def _solve(first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig) -> _Solution:
    """Alignment from the pairs and the prior, with the normalised error of each pair given all others."""
    n = len(pairs)
    known = np.zeros((6, 6)) if prior.covariance is None else prior.covariance
    if n == 0:
        return _Solution(prior.T, known, 0.0, 0, np.empty(0))
    a, b = first.select(pairs[:, 0]), second.select(pairs[:, 1])
    R = prior.T[:3, :3]
    C = a.covariance + turned(turned(b.covariance, R).T, R) + config.position_noise**2 * np.eye(3 * n)
    error = (a.points - transform_points(prior.T, b.points)).ravel()
    weight = blas.inverse(C)
    if prior.covariance is None:
        return _Solution(prior.T, known, float(error @ weight @ error), 3 * n, _pair_nis(weight, weight @ error))
    J = _alignment_jacobian(prior.T, b.points)
    weighted = weight @ J
    covariance = np.linalg.inv(J.T @ weighted + np.linalg.inv(prior.covariance))
    step = covariance @ (weighted.T @ error)
    residual = error - J @ step
    total = residual @ weight @ residual + step @ np.linalg.solve(prior.covariance, step)
    marginal = weight - weighted @ covariance @ weighted.T
    return _Solution(boxplus(prior.T, step), covariance, float(total), 3 * n, _pair_nis(marginal, weight @ residual))


def turned(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Rows (3n, m) that belong to n points, with each point's three turned by ``R`` (3, 3)."""
    return np.asarray((R @ rows.reshape(len(rows) // 3, 3, rows.shape[1])).reshape(rows.shape))


def _alignment_jacobian(T: FloatArray, points: FloatArray) -> FloatArray:
    """Derivative (3n, 6) of ``T [+] d`` applied to ``points``."""
    J = np.zeros((len(points), 3, 6))
    J[:, :, :3] = np.eye(3)
    J[:, :, 3:] = -skew(points @ T[:3, :3].T)
    return J.reshape(-1, 6)


def _pair_nis(weight: FloatArray, weighted_error: FloatArray) -> FloatArray:
    """Squared error of each pair as the others predict it, normalised: 3 degrees of freedom each (Baarda 1968)."""
    n = len(weighted_error) // 3
    blocks = weight.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :] + 1e-12 * np.eye(3)
    e = weighted_error.reshape(n, 3)
    return np.asarray(np.einsum("ni,ni->n", e, np.linalg.solve(blocks, e[..., None])[..., 0]))
