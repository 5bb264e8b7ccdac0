# SPDX-License-Identifier: Apache-2.0
"""Smoothing in the plane (thesis 1.7, 6.5).

All poses and landmarks at once, by sparse least squares on the measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ekf_slam_node.association.jcbb import IndexArray
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import POSE_DIM, PlanarConfig, move, place, range_bearing, wrap


@dataclass(frozen=True, eq=False)
class PlanarGraph:
    """Paths of one or several robots and what they saw, all landmarks known by their index.

    motions: (m, 3) from each pose to the next of the same robot; motion_covariance: one (3, 3), or each its own
    (m, 3, 3). pose_index, landmark_index: who saw what, (k,); measured: range and bearing, (k, 2). starts: the pose at
    which each robot's path begins; the poses of all robots are numbered through.
    """

    motions: FloatArray
    motion_covariance: FloatArray
    pose_index: IndexArray
    landmark_index: IndexArray
    measured: FloatArray
    starts: tuple[int, ...] = (0,)

    @property
    def before(self) -> IndexArray:
        """Pose that each motion starts at, (m,)."""
        poses = len(self.motions) + len(self.starts)
        ends = [start - 1 for start in (*self.starts[1:], poses)]
        return np.setdiff1d(np.arange(poses), ends)


@dataclass(frozen=True, eq=False)
class PlanarMap:
    """Poses (n, 3), the first fixed at its value, and landmarks (l, 2)."""

    poses: FloatArray
    landmarks: FloatArray


def initial_map(graph: PlanarGraph, first_pose: FloatArray) -> PlanarMap:
    """Dead reckoning, each landmark where it was first seen from."""
    if len(graph.starts) > 1:
        raise ValueError(f"{len(graph.starts)} paths need a start each: give smooth() an initial map")
    poses = [np.asarray(first_pose, dtype=np.float64)]
    for motion in graph.motions:
        poses.append(move(poses[-1], motion)[0])
    _, first = np.unique(graph.landmark_index, return_index=True)
    landmarks = [place(poses[graph.pose_index[k]], graph.measured[k])[0] for k in first]
    return PlanarMap(np.array(poses), np.array(landmarks))


def smooth(
    graph: PlanarGraph,
    first_pose: FloatArray,
    config: PlanarConfig,
    start: PlanarMap | None = None,
    optimizer: LevenbergMarquardtConfig | None = None,
) -> tuple[PlanarMap, LeastSquaresResult]:
    """The most likely poses and landmarks, the first pose held fixed; from ``start``, or from dead reckoning."""
    return levenberg_marquardt(_Problem(graph, config), start or initial_map(graph, first_pose), optimizer)


def pose_covariances(graph: PlanarGraph, state: PlanarMap, config: PlanarConfig, poses: IndexArray) -> FloatArray:
    """Marginal covariances (n, 3, 3) of some poses of a smoothed map; of the first pose zero."""
    problem = _Problem(graph, config)
    problem.linearize(state)
    return problem.covariances(poses)


def cost(graph: PlanarGraph, state: PlanarMap, config: PlanarConfig) -> float:
    """Sum of the squared whitened residuals of a map; what :func:`smooth` minimises."""
    return _Problem(graph, config).cost(state)


def sighting_nis(graph: PlanarGraph, state: PlanarMap, config: PlanarConfig) -> FloatArray:
    """Squared whitened residual (k,) of every sighting, 2 degrees of freedom."""
    error = _Problem(graph, config).sightings(state)
    return np.asarray(np.sum(error**2, axis=1))


class _Problem:
    """Whitened residuals, motions first, and their Jacobian without the first pose."""

    def __init__(self, graph: PlanarGraph, config: PlanarConfig) -> None:
        self._graph = graph
        covariance = np.broadcast_to(graph.motion_covariance, (len(graph.motions), POSE_DIM, POSE_DIM))
        self._W = np.linalg.inv(np.linalg.cholesky(covariance))
        self._before = graph.before
        self._sigma = np.array([config.sigma_range, config.sigma_bearing])
        self._H = sp.csc_matrix((0, 0))
        self._gradient = np.zeros(0)

    def cost(self, state: PlanarMap) -> float:
        motions, sightings = self._residuals(state)
        return float(np.sum(motions**2) + np.sum(sightings**2))

    def sightings(self, state: PlanarMap) -> FloatArray:
        """Whitened residuals (k, 2) of the sightings."""
        return np.asarray(self._seen(state)[0] / self._sigma)

    def _residuals(self, state: PlanarMap) -> tuple[FloatArray, FloatArray]:
        before, after = state.poses[self._before], state.poses[self._before + 1]
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        step = after[:, :2] - before[:, :2]
        error = np.column_stack(
            [c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1], after[:, 2] - before[:, 2]]
        )
        error -= self._graph.motions
        error[:, 2] = wrap(error[:, 2])
        return np.einsum("kij,kj->ki", self._W, error), self.sightings(state)

    def _seen(self, state: PlanarMap) -> tuple[FloatArray, FloatArray, FloatArray]:
        graph = self._graph
        error = np.empty_like(graph.measured)
        J_pose, J_landmark = np.empty((len(error), 2, 3)), np.empty((len(error), 2, 2))
        poses, points = state.poses[graph.pose_index], state.landmarks[graph.landmark_index]
        delta = points - poses[:, :2]
        z, _, J_landmark = range_bearing(np.zeros(3), delta)
        J_pose = np.concatenate([-J_landmark, np.broadcast_to([[0.0], [-1.0]], (len(error), 2, 1))], axis=2)
        error = z - graph.measured
        error[:, 1] = wrap(error[:, 1] - poses[:, 2])
        return error, J_pose, J_landmark

    def linearize(self, state: PlanarMap) -> FloatArray:
        motions, sightings = self._residuals(state)
        J = sp.vstack([self._motion_jacobian(state), self._sighting_jacobian(state)]).tocsc()[:, POSE_DIM:]
        self._H = (J.T @ J).tocsc()
        self._gradient = np.asarray(J.T @ np.concatenate([motions.ravel(), sightings.ravel()]))
        return self._gradient

    def _motion_jacobian(self, state: PlanarMap) -> sp.spmatrix:
        n = len(self._before)
        start, end = state.poses[self._before], state.poses[self._before + 1]
        c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
        Rt = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
        after = np.tile(np.eye(POSE_DIM), (n, 1, 1))
        after[:, :2, :2] = Rt
        before = -after
        moved = np.einsum("kij,kj->ki", Rt, (end - start)[:, :2])
        before[:, 0, 2], before[:, 1, 2] = moved[:, 1], -moved[:, 0]
        return self._blocks(self._W @ before, self._before, state) + self._blocks(
            self._W @ after, self._before + 1, state
        )

    def _sighting_jacobian(self, state: PlanarMap) -> sp.spmatrix:
        _, J_pose, J_landmark = self._seen(state)
        scale = 1.0 / self._sigma[:, None]
        by_pose = self._blocks(scale * J_pose, self._graph.pose_index, state)
        first = POSE_DIM * len(state.poses) + 2 * self._graph.landmark_index
        return by_pose + self._scattered(scale * J_landmark, first, state)

    def _blocks(self, blocks: FloatArray, pose_index: IndexArray, state: PlanarMap) -> sp.spmatrix:
        return self._scattered(blocks, POSE_DIM * np.asarray(pose_index), state)

    def _scattered(self, blocks: FloatArray, first: IndexArray, state: PlanarMap) -> sp.spmatrix:
        """Blocks (k, r, c) below each other, each in the columns from ``first`` (k,) on."""
        k, r, c = blocks.shape
        rows = np.broadcast_to(np.arange(k * r).reshape(k, r, 1), blocks.shape)
        columns = np.broadcast_to(first[:, None, None] + np.arange(c), blocks.shape)
        width = POSE_DIM * len(state.poses) + 2 * len(state.landmarks)
        return sp.csc_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(k * r, width))

    def solve(self, damping: float) -> FloatArray | None:
        H = self._H + sp.diags(damping * self._H.diagonal())
        try:
            factor = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        except RuntimeError:
            return None
        step = factor.solve(-self._gradient)
        return np.asarray(step) if np.isfinite(step).all() else None

    def covariances(self, poses: IndexArray) -> FloatArray:
        """Blocks (n, 3, 3) of the inverse of the information at the last linearisation."""
        factor = splu(self._H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        out = np.zeros((len(poses), POSE_DIM, POSE_DIM))
        for k, pose in enumerate(np.asarray(poses)):
            if pose == 0:
                continue
            rows = POSE_DIM * (pose - 1) + np.arange(POSE_DIM)
            unit = np.zeros((self._H.shape[0], POSE_DIM))
            unit[rows, np.arange(POSE_DIM)] = 1.0
            out[k] = factor.solve(unit)[rows]
        return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))

    def retract(self, state: PlanarMap, step: FloatArray) -> PlanarMap:
        split = POSE_DIM * (len(state.poses) - 1)
        poses = state.poses.copy()
        poses[1:] += step[:split].reshape(-1, POSE_DIM)
        poses[:, 2] = wrap(poses[:, 2])
        return PlanarMap(poses, state.landmarks + step[split:].reshape(-1, 2))
