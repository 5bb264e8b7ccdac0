# SPDX-License-Identifier: Apache-2.0
"""A pose graph in the plane: poses (x, y, yaw) joined by relative measurements, loops with a robust loss."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from slam_core.geometry import FloatArray

LOOP_SCALE = 3.0
"""Whitened error (sigma) from which a loop loses weight (Geman-McClure)."""


def wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def relative(a: FloatArray, b: FloatArray) -> FloatArray:
    """Poses (..., 3) ``b`` as seen from ``a``."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrapped(b[..., 2] - a[..., 2])], axis=-1)


def composed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Pose ``b`` (3,), given in ``a`` (3,), in the frame of ``a``."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrapped(a[2] + b[2])])


@dataclass
class PlanarGraph:
    """Poses (n, 3) and edges: from, to, measured pose of ``to`` in ``from``, square root of the information (3, 3)."""

    poses: list[FloatArray] = field(default_factory=list)
    _edges: list[tuple[int, int, FloatArray, FloatArray, bool]] = field(default_factory=list)

    def add_edge(self, i: int, j: int, measured: FloatArray, covariance: FloatArray, *, loop: bool) -> None:
        """Join two poses by the measured pose (3,) of ``j`` in ``i``; only loops may be with_calibration_error."""
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        self._edges.append((i, j, measured, whitening, loop))

    def optimise(self, iterations: int = 15) -> None:
        """Gauss-Newton with the first pose held."""
        i, j = (np.array([edge[k] for edge in self._edges]) for k in (0, 1))
        measured, whitening = (np.array([edge[k] for edge in self._edges]) for k in (2, 3))
        loop = np.array([edge[4] for edge in self._edges])
        poses = np.array(self.poses)
        for _ in range(iterations):
            error, J_i, J_j = _linearised(poses[i], poses[j], measured)
            residual = np.einsum("nrc,nc->nr", whitening, error)
            square = (residual**2).sum(axis=1)
            root = np.where(loop, LOOP_SCALE**2 / (LOOP_SCALE**2 + square), 1.0)[:, None, None]
            step = _solved(len(poses), i, j, root * (whitening @ J_i), root * (whitening @ J_j), root[:, 0] * residual)
            poses[1:] += step.reshape(-1, 3)
            poses[:, 2] = wrapped(poses[:, 2])
            if np.abs(step).max() < 1e-5:
                break
        self.poses = list(poses)


def _linearised(a: FloatArray, b: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Error (m, 3) of each edge and its Jacobians (m, 3, 3) by both poses."""
    between = relative(a, b)
    error = between - measured
    error[:, 2] = wrapped(error[:, 2])
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    J_a, J_b = np.zeros((len(a), 3, 3)), np.zeros((len(a), 3, 3))
    J_b[:, 0, 0], J_b[:, 0, 1], J_b[:, 1, 0], J_b[:, 1, 1], J_b[:, 2, 2] = c, s, -s, c, 1.0
    J_a[:] = -J_b
    J_a[:, 0, 2], J_a[:, 1, 2] = between[:, 1], -between[:, 0]
    return error, J_a, J_b


def _solved(n: int, i: FloatArray, j: FloatArray, J_i: FloatArray, J_j: FloatArray, residual: FloatArray) -> FloatArray:
    """Step (3 (n - 1),) of the least-squares problem."""
    rows = 3 * np.arange(len(i))[:, None, None] + np.arange(3)[:, None] + np.zeros(3, dtype=int)
    columns = [3 * k[:, None, None] + np.arange(3) + np.zeros((3, 1), dtype=int) for k in (i, j)]
    data = np.concatenate([J_i.ravel(), J_j.ravel()])
    where = (np.tile(rows.ravel(), 2), np.concatenate([c.ravel() for c in columns]))
    A = scipy.sparse.csr_matrix((data, where), shape=(3 * len(i), 3 * n))[:, 3:]
    return np.asarray(scipy.sparse.linalg.spsolve((A.T @ A).tocsc(), -A.T @ residual.ravel()))
