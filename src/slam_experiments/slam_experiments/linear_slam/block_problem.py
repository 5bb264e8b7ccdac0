# SPDX-License-Identifier: Apache-2.0
"""Joining with the thesis's rows (Algorithm 4).

Every landmark of a submap with its own covariance, uncorrelated with the rest.

Then no landmark is coupled to another, and all of them are eliminated one by one before the sparse solver sees the
problem (:mod:`slam_experiments.linear_slam.sighting_kernels`), which is left with the poses alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import solved_covariance, variable_scalars
from sjsam_node.joint_problem.layout import Layout, make_layout
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState, LocalMap, flatten
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers
from slam_core.linear_algebra.sparse_cholesky import SparseCholesky
from slam_experiments.linear_slam.sighting_kernels import KERNELS, counting_order, pair_positions, pose_pairs


class FlatRows(NamedTuple):
    """Local maps of uncorrelated rows: the poses they measured, and their landmarks one by one.

    sighting_ptr (maps + 1,): where those of each map start. pose (o,) that saw a landmark (o,), mean (o, d) and
    information (o, d, d) of what it saw.
    """

    odometry: FlatMaps
    sighting_ptr: IntArray
    pose: IntArray
    landmark: IntArray
    mean: FloatArray
    information: FloatArray

    def first(self, count: int) -> FlatRows:
        """The first ``count`` local maps, without copying the values."""
        n = self.sighting_ptr[count]
        return FlatRows(
            self.odometry.first(count), self.sighting_ptr[: count + 1], self.pose[:n], self.landmark[:n],
            self.mean[:n], self.information[:n],
        )  # fmt: skip


def flatten_rows(maps: Sequence[LocalMap], pose_size: int, d: int) -> FlatRows:
    """The rows of local maps, each pose and landmark on its own, whatever correlates them."""
    counts = [len(m.landmarks) for m in maps]
    first = [pose_size * len(m.poses) for m in maps]
    blocks = [_diagonal_blocks(m.information, n, d) for m, n in zip(maps, first, strict=True)]
    return FlatRows(
        flatten([_pose_rows(m, n) for m, n in zip(maps, first, strict=True)]),
        pointers(counts),
        np.repeat(np.array([m.reference for m in maps], dtype=np.int64), counts),
        np.concatenate([m.landmarks for m in maps]),
        np.concatenate([m.mean[n:].reshape(-1, d) for m, n in zip(maps, first, strict=True)]),
        np.concatenate(blocks),
    )


class Sightings(NamedTuple):
    """Landmarks as seen from reference poses, sorted by landmark, those of one landmark as their poses are eliminated.

    Pose (o,), mean (o, d), information (o, d, d), landmark (o,).
    """

    landmark_ptr: IntArray
    pose: IntArray
    mean: FloatArray
    information: FloatArray
    landmark: IntArray


class BlockProblem:
    """Least squares of :class:`~sjsam_node.joint_problem.joining.JoiningProblem` over maps of uncorrelated rows.

    Unknowns are ordered poses first, then landmarks; parameters as there.
    """

    def __init__(self, rows: FlatRows, state: JoiningState, fixed: IntArray, model: int, backend: str = "auto") -> None:
        self.model, d = model, state.translations.shape[1]
        self._kernels = KERNELS[d]
        poses, landmarks = len(state.translations), len(state.landmarks)
        self.odometry, pose, landmark = rows.odometry, rows.pose, rows.landmark
        self.layout: Layout = make_layout(_coupled(self.odometry, pose, landmark, poses, landmarks), poses, 0, fixed, d)
        self.factor = SparseCholesky(self.layout.pattern, backend)
        pattern, offset = self.layout.pattern, self.layout.pose_offset
        block = np.where(offset >= 0, np.searchsorted(pattern.start, offset, side="right") - 1, -1)
        by_pose = counting_order(block[pose] + 1, len(pattern.width) + 1)[1]
        landmark_ptr, by_landmark = counting_order(landmark[by_pose], landmarks)
        order = by_pose[by_landmark]
        self.sightings = Sightings(
            landmark_ptr, pose[order], rows.mean[order], rows.information[order], landmark[order]
        )
        pose_ptr, by_pose = counting_order(self.sightings.pose, poses)
        self._pair_ptr, self._pair = pair_positions(
            landmark_ptr, self.sightings.landmark, self.sightings.pose, pose_ptr, by_pose, block, pattern.column_ptr,
            pattern.rows, pattern.row_offset + np.repeat(pattern.value_ptr[:-1], np.diff(pattern.column_ptr)),
        )  # fmt: skip
        self._position, self._stride = pattern.value_ptr[block], pattern.height[block]
        self._landmark_offset = pattern.n + d * np.arange(landmarks, dtype=np.int64)
        self._values, self._gradient = np.zeros(int(pattern.value_ptr[-1])), np.zeros(pattern.n + d * landmarks)
        count = len(self.sightings.pose)
        self._M, self._v = np.zeros((count, d, d)), np.zeros((count, d))
        self._V, self._K = np.zeros((landmarks, d, d)), np.zeros((landmarks, d, d))
        self._F = np.zeros((count, d, d))

    @property
    def backend(self) -> str:
        """The solver that runs."""
        return self.factor.backend

    def cost(self, state: JoiningState) -> float:
        """chi2 of the rows."""
        arrays = state.rotations, state.translations, state.landmarks
        poses = kernels.joint_cost(self.model, self.odometry, *arrays)
        return float(poses + self._kernels.cost(self.sightings, *arrays))

    def linearize(self, state: JoiningState) -> FloatArray:
        """Gradient over poses and landmarks; keeps the blocks that the Schur complement is made of."""
        self._values[:] = 0.0
        self._gradient[:] = 0.0
        arrays, n = (state.rotations, state.translations, state.landmarks), self.layout.pattern.n
        kernels.joint_linearize(self.model, self.odometry, *arrays, self.layout.scatter, self._values, self._gradient)
        self._kernels.linearize(
            self.sightings, *arrays, self.layout.pose_offset, n, self._position, self._stride, self._values,
            self._gradient, self._M, self._v, self._V,
        )  # fmt: skip
        return self._gradient.copy()

    def solve(self, damping: float) -> FloatArray | None:
        """Damped step over poses and landmarks, or None where the matrix is not positive definite."""
        return self.resolve(self._gradient) if self._factorize(damping) else None

    def _factorize(self, damping: float) -> bool:
        values = self._values.copy()
        values[self.layout.pattern.diagonal] *= 1.0 + damping
        if not self._kernels.factor_landmarks(self.sightings, damping, self._M, self._V, self._K, self._F):
            return False
        self._kernels.reduce(self.sightings, self._pair_ptr, self._pair, self._stride, self._v, self._F, values)
        return self.factor.factorize(values)

    def gradient(self, state: JoiningState) -> FloatArray:
        """Gradient alone over poses and landmarks."""
        out = np.zeros_like(self._gradient)
        arrays = state.rotations, state.translations, state.landmarks
        kernels.joint_gradient(self.model, self.odometry, *arrays, self.layout.scatter, out)
        self._kernels.gradient(self.sightings, *arrays, self.layout.pose_offset, self.layout.pattern.n, out)
        return out

    def resolve(self, gradient: FloatArray) -> FloatArray:
        """Step for this gradient with the last factor."""
        n, offset = self.layout.pattern.n, self.layout.pose_offset
        right, step = gradient.copy(), np.empty_like(gradient)
        self._kernels.reduce_gradient(self.sightings, offset, n, self._v, self._K, self._F, right)
        step[:n] = self.factor.solve(-right[:n])
        self._kernels.recover(self.sightings, offset, n, self._v, self._K, self._F, right, step)
        return step

    def retract(self, state: JoiningState, step: FloatArray) -> JoiningState:
        """The state moved by ``step``."""
        return state.retract(self.layout.pose_offset, self._landmark_offset, step)

    def optimize(
        self, state: JoiningState, config: LevenbergMarquardtConfig | None = None
    ) -> tuple[JoiningState, LeastSquaresResult]:
        """The optimum reached from ``state``."""
        return levenberg_marquardt(self, state, config)

    def columns(self, state: JoiningState, poses: IntArray) -> FloatArray:
        """Joint covariance of a few poses, linearised at ``state``.

        Raises
        ------
        ValueError
            If the problem does not determine all its variables.
        """
        self.linearize(state)
        if not self._factorize(0.0):
            raise ValueError("the normal equations are singular: part of the map hangs on nothing")
        no_landmarks = np.empty(0, dtype=np.int64)
        return solved_covariance(
            self.factor, variable_scalars(self.layout, state.model_dimensions, poses, no_landmarks)
        )


def _pose_rows(m: LocalMap, rows: int) -> LocalMap:
    return LocalMap(m.reference, m.poses, m.landmarks[:0], m.mean[:rows], m.information[:rows, :rows])


def _diagonal_blocks(A: FloatArray, first: int, d: int) -> FloatArray:
    """Blocks (n, d, d) on the diagonal of a square matrix from row ``first`` on, as a view."""
    A = np.ascontiguousarray(A)
    down, right = A.strides
    strides = (d * (down + right), down, right)
    return np.ndarray(((len(A) - first) // d, d, d), A.dtype, A, first * (down + right), strides)


def _coupled(odometry: FlatMaps, pose: IntArray, landmark: IntArray, poses: int, landmarks: int) -> FlatMaps:
    """Coupled poses: the odometry's maps, then one without values for every two that share a landmark."""
    landmark_ptr, by_landmark = counting_order(landmark, landmarks)
    pose_ptr, by_pose = counting_order(pose, poses)
    first, second = pose_pairs(landmark_ptr, by_landmark, pose_ptr, by_pose, pose, landmark)
    none = np.zeros(len(odometry.reference) + len(first) + 1, dtype=np.int64)
    return FlatMaps(
        np.concatenate([odometry.reference, first]),
        np.concatenate([odometry.pose_ptr, odometry.pose_ptr[-1] + 1 + np.arange(len(first))]),
        np.concatenate([odometry.poses[: odometry.pose_ptr[-1]], second]), none, none[:0], none, np.empty(0), none,
        np.empty(0), np.empty(0),
    )  # fmt: skip
