"""Smoothing in the plane (thesis 1.7, 6.5): all poses and landmarks at once, by sparse least squares on the
measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ekf_slam_node.jcbb import IndexArray
from ekf_slam_node.planar import POSE_DIM, PlanarConfig, move, place, range_bearing, turn, wrap
from slam_core.geometry import FloatArray
from slam_core.least_squares import LeastSquaresResult, levenberg_marquardt, whitening


@dataclass(frozen=True, eq=False)
class PlanarGraph:
    """Motions (n - 1, 3) between n poses with one covariance (3, 3); sightings: pose and landmark index (m,), z (m,
    2).
    """

    motions: FloatArray
    motion_covariance: FloatArray
    pose_index: IndexArray
    landmark_index: IndexArray
    measured: FloatArray


@dataclass(frozen=True, eq=False)
class PlanarMap:
    """Poses (n, 3), the first fixed at its value, and landmarks (l, 2)."""

    poses: FloatArray
    landmarks: FloatArray


def initial_map(graph: PlanarGraph, first_pose: FloatArray) -> PlanarMap:
    """Dead reckoning, each landmark where it was first seen from."""
    poses = [np.asarray(first_pose, dtype=np.float64)]
    for motion in graph.motions:
        poses.append(move(poses[-1], motion)[0])
    _, first = np.unique(graph.landmark_index, return_index=True)
    landmarks = [place(poses[graph.pose_index[k]], graph.measured[k])[0] for k in first]
    return PlanarMap(np.array(poses), np.array(landmarks))


def smooth(graph: PlanarGraph, first_pose: FloatArray, config: PlanarConfig) -> tuple[PlanarMap, LeastSquaresResult]:
    """The most likely poses and landmarks."""
    return levenberg_marquardt(_Problem(graph, config), initial_map(graph, first_pose))


def cost(graph: PlanarGraph, state: PlanarMap, config: PlanarConfig) -> float:
    """Sum of the squared whitened residuals of a map; what :func:`smooth` minimises."""
    return _Problem(graph, config).cost(state)


class _Problem:
    """Whitened residuals, motions first, and their Jacobian without the first pose."""

    def __init__(self, graph: PlanarGraph, config: PlanarConfig) -> None:
        self._graph = graph
        self._W = whitening(graph.motion_covariance)
        self._sigma = np.array([config.sigma_range, config.sigma_bearing])
        self._H = sp.csc_matrix((0, 0))
        self._gradient = np.zeros(0)

    def cost(self, state: PlanarMap) -> float:
        motions, sightings = self._residuals(state)
        return float(np.sum(motions**2) + np.sum(sightings**2))

    def _residuals(self, state: PlanarMap) -> tuple[FloatArray, FloatArray]:
        graph, before, after = self._graph, state.poses[:-1], state.poses[1:]
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        step = after[:, :2] - before[:, :2]
        error = np.column_stack(
            [c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1], after[:, 2] - before[:, 2]]
        )
        error -= graph.motions
        error[:, 2] = wrap(error[:, 2])
        return error @ self._W.T, self._seen(state)[0] / self._sigma

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
        n = len(state.poses) - 1
        before, after = np.empty((n, 3, 3)), np.empty((n, 3, 3))
        for k, (a, b) in enumerate(zip(state.poses[:-1], state.poses[1:], strict=True)):
            Rt = turn(a[2]).T
            J = np.eye(3)
            J[:2, :2] = Rt
            after[k] = self._W @ J
            J = -J
            J[:2, 2] = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ Rt @ (b - a)[:2]
            before[k] = self._W @ J
        return self._blocks(before, np.arange(n), state) + self._blocks(after, np.arange(1, n + 1), state)

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

    def retract(self, state: PlanarMap, step: FloatArray) -> PlanarMap:
        split = POSE_DIM * (len(state.poses) - 1)
        poses = state.poses.copy()
        poses[1:] += step[:split].reshape(-1, POSE_DIM)
        poses[:, 2] = wrap(poses[:, 2])
        return PlanarMap(poses, state.landmarks + step[split:].reshape(-1, 2))
