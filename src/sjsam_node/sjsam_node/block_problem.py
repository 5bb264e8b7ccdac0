"""Joining with the thesis's rows (Algorithm 4): every landmark of a submap with its own covariance, uncorrelated with
the rest.

Then no landmark is coupled to another, and all of them are eliminated one by one before the sparse solver sees the
problem: the Schur complement of each is a small dense matrix over the poses that see it.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sjsam_node import kernels
from sjsam_node.layout import Layout, make_layout
from sjsam_node.problem import FlatMaps, LocalMap, State, flatten, pointers
from slam_core.geometry import FloatArray
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.sparse_cholesky import IntArray, SparseCholesky


class Sightings(NamedTuple):
    """Landmarks as seen from reference poses, sorted by landmark: pose (o,), mean (o, d), information (o, d, d)."""

    landmark_ptr: IntArray
    pose: IntArray
    mean: FloatArray
    information: FloatArray


class BlockProblem:
    """The same least squares as :class:`~sjsam_node.joining.JoiningProblem` over maps of uncorrelated rows.

    Unknowns are ordered poses first, then landmarks; parameters as there.
    """

    def __init__(self, maps: list[LocalMap], state: State, fixed: IntArray, model: int, backend: str = "auto") -> None:
        self.model, self._pose_size = model, state.model_dimensions[0]
        dimension = state.translations.shape[1]
        self.odometry = flatten([_pose_rows(m, self._pose_size) for m in maps])
        self.sightings = _sightings(maps, self._pose_size, dimension, len(state.landmarks))
        cliques = _cliques(self.odometry, self.sightings)
        self.layout: Layout = make_layout(cliques, len(state.translations), 0, fixed, dimension)
        self.factor = SparseCholesky(self.layout.pattern, backend)
        pattern = self.layout.pattern
        self._diagonal = np.nonzero(pattern.indices == pattern.columns)[0]
        self._landmark_offset = pattern.n + dimension * np.arange(len(state.landmarks), dtype=np.int64)
        self._values, self._gradient = np.zeros(len(pattern.indices)), np.zeros(pattern.n + state.landmarks.size)
        o, d, dp = len(self.sightings.pose), dimension, self._pose_size
        self._pose_jacobian, self._cross = np.zeros((o, dp, dp)), np.zeros((o, dp, d))
        self._landmark_block = np.zeros((len(state.landmarks), d, d))

    @property
    def backend(self) -> str:
        """The solver that runs."""
        return self.factor.backend

    def cost(self, state: State) -> float:
        """chi2 of the rows."""
        poses = kernels.joint_cost(self.model, self.odometry, state.rotations, state.translations, state.landmarks)
        return float(poses + _sightings_cost(self.sightings, state.rotations, state.translations, state.landmarks))

    def linearize(self, state: State) -> FloatArray:
        """Gradient over poses and landmarks; keeps the blocks that the Schur complement is made of."""
        self._values[:] = 0.0
        self._gradient[:] = 0.0
        R, t, points = state.rotations, state.translations, state.landmarks
        n = self.layout.pattern.n
        kernels.joint_linearize(
            self.model, self.odometry, R, t, points, self.layout.scatter, self._values, self._gradient
        )
        _linearize_sightings(
            self.sightings, R, t, points, self.layout.pose_offset, n, self._pose_jacobian, self._cross,
            self._landmark_block, self._gradient,
        )  # fmt: skip
        return self._gradient.copy()

    def solve(self, damping: float) -> FloatArray | None:
        """Damped step over poses and landmarks, or None where the matrix is not positive definite."""
        n = self.layout.pattern.n
        values, reduced = self._values.copy(), self._gradient[:n].copy()
        values[self._diagonal] *= 1.0 + damping
        inverse = np.linalg.inv(self._landmark_block * (1.0 + damping * np.eye(self._landmark_block.shape[1])))
        right = self._gradient[n:].reshape(len(inverse), -1)
        first = len(self.odometry.reference)
        _reduce(self.sightings, first, self._pose_jacobian, self._cross, inverse, right, damping,
                self.layout.scatter, values, reduced)  # fmt: skip
        if not self.factor.factorize(values):
            return None
        poses = self.factor.solve(-reduced)
        offset = self.layout.pose_offset
        return np.concatenate([poses, _recover(self.sightings, self._cross, inverse, right, offset, poses).ravel()])

    def retract(self, state: State, step: FloatArray) -> State:
        """The state moved by ``step``."""
        return state.retract(self.layout.pose_offset, self._landmark_offset, step)

    def optimize(
        self, state: State, config: LevenbergMarquardtConfig | None = None
    ) -> tuple[State, LeastSquaresResult]:
        """The optimum reached from ``state``."""
        return levenberg_marquardt(self, state, config)


def _pose_rows(m: LocalMap, pose_size: int) -> LocalMap:
    rows = pose_size * len(m.poses)
    return LocalMap(m.reference, m.poses, m.landmarks[:0], m.mean[:rows], m.information[:rows, :rows])


def _sightings(maps: list[LocalMap], pose_size: int, dimension: int, landmarks: int) -> Sightings:
    """All landmark rows of all maps, sorted by landmark and then by map."""
    ids, pose, mean, information = [], [], [], []
    for m in maps:
        first, count = pose_size * len(m.poses), len(m.landmarks)
        k = np.arange(count)
        blocks = m.information[first:, first:].reshape(count, dimension, count, dimension)[k, :, k, :]
        ids.append(m.landmarks)
        pose.append(np.full(count, m.reference, dtype=np.int64))
        mean.append(m.mean[first:].reshape(-1, dimension))
        information.append(blocks)
    landmark = np.concatenate(ids)
    order = np.argsort(landmark, kind="stable")
    return Sightings(
        pointers(np.bincount(landmark, minlength=landmarks)), np.concatenate(pose)[order],
        np.concatenate(mean)[order], np.ascontiguousarray(np.concatenate(information)[order]),
    )  # fmt: skip


def _cliques(odometry: FlatMaps, sightings: Sightings) -> FlatMaps:
    """Which poses are coupled: by odometry, and by each landmark; maps without values."""
    start, end = sightings.landmark_ptr[:-1], sightings.landmark_ptr[1:]
    others = np.ones(len(sightings.pose), dtype=bool)
    others[start[end > start]] = False
    count = np.maximum(end - start - 1, 0)
    seen = end > start
    none = np.zeros(len(odometry.reference) + int(seen.sum()) + 1, dtype=np.int64)
    return FlatMaps(
        np.concatenate([odometry.reference, sightings.pose[start[seen]]]),
        np.concatenate([odometry.pose_ptr, odometry.pose_ptr[-1] + np.cumsum(count[seen])]),
        np.concatenate([odometry.poses, sightings.pose[others]]),
        none, none[:0], none, np.empty(0), none, np.empty(0),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _sightings_cost(sightings, R, t, points):
    landmark_ptr, pose, mean, information = sightings
    d = t.shape[1]
    e = np.empty(d)
    total = 0.0
    for landmark in range(len(landmark_ptr) - 1):
        for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
            i = pose[o]
            for p in range(d):
                e[p] = -mean[o, p]
                for q in range(d):
                    e[p] += R[i, q, p] * (points[landmark, q] - t[i, q])
            for p in range(d):
                for q in range(d):
                    total += e[p] * information[o, p, q] * e[q]
    return total


@njit(cache=True, nogil=True)
def _linearize_sightings(sightings, R, t, points, pose_offset, n, pose_block, cross, landmark_block, gradient):
    """Blocks of J^T information J of every sighting: pose, pose x landmark, landmark; and the gradient.

    With the residual turned to map axes, ``e = (l - t) - R z``, the Jacobian is [-I, [l - t]x] for the pose and I for
    the landmark, and the information is ``R information R^T``.
    """
    landmark_ptr, pose, mean, information = sightings
    d = t.shape[1]
    dp = pose_block.shape[1]
    J, v, weighted = np.zeros((d, dp)), np.empty(d), np.empty(d)
    M, half = np.empty((d, d)), np.empty((d, d))
    for landmark in range(len(landmark_ptr) - 1):
        landmark_block[landmark] = 0.0
        if landmark_ptr[landmark] == landmark_ptr[landmark + 1]:  # seen by none: stays there
            for p in range(d):
                landmark_block[landmark, p, p] = 1.0
        for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
            i = pose[o]
            for p in range(d):
                v[p] = points[landmark, p] - t[i, p]
                for q in range(d):
                    half[p, q] = 0.0
                    for s in range(d):
                        half[p, q] += R[i, p, s] * information[o, s, q]
            for p in range(d):
                J[p, p] = -1.0
                for q in range(d):
                    M[p, q] = 0.0
                    for s in range(d):
                        M[p, q] += half[p, s] * R[i, q, s]
            if d == 2:
                J[0, 2], J[1, 2] = v[1], -v[0]
            else:
                J[0, 4], J[0, 5], J[1, 3] = -v[2], v[1], v[2]
                J[1, 5], J[2, 3], J[2, 4] = -v[0], -v[1], v[0]
            for p in range(d):
                weighted[p] = 0.0
                for q in range(d):
                    e = v[q]
                    for s in range(d):
                        e -= R[i, q, s] * mean[o, s]
                    weighted[p] += M[p, q] * e
            for p in range(d):
                gradient[n + d * landmark + p] += weighted[p]
                for q in range(d):
                    landmark_block[landmark, p, q] += M[p, q]
            for a in range(dp):
                for q in range(d):
                    value = 0.0
                    for p in range(d):
                        value += J[p, a] * M[p, q]
                    cross[o, a, q] = value
                if pose_offset[i] >= 0:
                    for p in range(d):
                        gradient[pose_offset[i] + a] += J[p, a] * weighted[p]
            for a in range(dp):
                for b in range(dp):
                    value = 0.0
                    for q in range(d):
                        value += cross[o, a, q] * J[q, b]
                    pose_block[o, a, b] = value


@njit(cache=True, nogil=True)
def _reduce(sightings, first, pose_block, cross, inverse, right, damping, scatter, values, reduced):
    """Add every landmark's pose blocks less its Schur complement; ``reduced`` loses what landmarks explain."""
    landmark_ptr = sightings[0]
    dp, d = cross.shape[1], cross.shape[2]
    longest = 0
    for landmark in range(len(landmark_ptr) - 1):
        longest = max(longest, landmark_ptr[landmark + 1] - landmark_ptr[landmark])
    work, gain = np.empty(longest * longest * dp * dp), np.empty((longest * dp, d))
    turned = np.empty((d, longest * dp))
    clique = first
    for landmark in range(len(landmark_ptr) - 1):
        start = landmark_ptr[landmark]
        k = landmark_ptr[landmark + 1] - start
        if k == 0:
            continue
        H, g = work[: k * k * dp * dp].reshape((k * dp, k * dp)), np.zeros(k * dp)
        for i in range(k):
            for a in range(dp):
                for q in range(d):
                    value = 0.0
                    for p in range(d):
                        value += cross[start + i, a, p] * inverse[landmark, p, q]
                    gain[i * dp + a, q] = value
                    g[i * dp + a] -= value * right[landmark, q]
        for i in range(k):
            for a in range(dp):
                for q in range(d):
                    turned[q, i * dp + a] = cross[start + i, a, q]
        for i in range(k * dp):
            for j in range(k * dp):
                H[i, j] = -gain[i, 0] * turned[0, j] - gain[i, 1] * turned[1, j]
            if d == 3:
                for j in range(k * dp):
                    H[i, j] -= gain[i, 2] * turned[2, j]
        for i in range(k):
            for a in range(dp):
                for b in range(dp):
                    scale = 1.0 + damping if a == b else 1.0
                    H[i * dp + a, i * dp + b] += scale * pose_block[start + i, a, b]
        kernels.scatter_dense(clique, H, g, scatter, values, reduced)
        clique += 1


@njit(cache=True, nogil=True)
def _recover(sightings, cross, inverse, right, pose_offset, step):
    """Steps of the landmarks given those of the poses."""
    landmark_ptr, pose = sightings[0], sightings[1]
    dp, d = cross.shape[1], cross.shape[2]
    out = np.zeros((len(landmark_ptr) - 1, d))
    b = np.empty(d)
    for landmark in range(len(out)):
        for q in range(d):
            b[q] = -right[landmark, q]
        for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
            offset = pose_offset[pose[o]]
            if offset >= 0:
                for a in range(dp):
                    for q in range(d):
                        b[q] -= cross[o, a, q] * step[offset + a]
        for p in range(d):
            for q in range(d):
                out[landmark, p] += inverse[landmark, p, q] * b[q]
    return out
