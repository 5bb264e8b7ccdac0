# SPDX-License-Identifier: Apache-2.0
"""The joining problem of block rows in Ceres (pyceres), with pycolmap's compiled residuals.

Point alignment and relative pose.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pyceres
import pycolmap
from memory import PeakMemory
from pycolmap import cost_functions
from scipy.spatial.transform import Rotation

from sjsam_node.joint_problem.problem import JoiningState, LocalMap
from slam_core.geometry import make_transform, so3_exp

THREADS = 1


def solve(maps: list[LocalMap], state: JoiningState, repeat: int) -> dict[str, Any]:
    """Levenberg-Marquardt with the sparse Schur complement."""
    memory, times = PeakMemory(), []
    for _ in range(repeat):
        problem, q, t, points = _problem(maps, state)
        options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
        options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
        options.num_threads = THREADS
        options.max_num_iterations = 200
        began = time.perf_counter()
        pyceres.solve(options, problem, summary)
        times.append(time.perf_counter() - began)
    R = Rotation.from_quat(q).as_matrix().transpose(0, 2, 1)
    optimum = JoiningState(np.ascontiguousarray(R), -np.einsum("nij,nj->ni", R, t), points)
    return {"batch": times, "memory": memory.grown(), "state": optimum}


def _problem(maps: list[LocalMap], state: JoiningState) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Poses enter as the map's frame seen from them: quaternions (x y z w) and translations."""
    R = state.rotations.transpose(0, 2, 1)
    q, t = Rotation.from_matrix(R).as_quat(), -np.einsum("nij,nj->ni", R, state.translations)
    points, scale = state.landmarks.copy(), np.ones(1)
    problem, manifold = pyceres.Problem(), pyceres.EigenQuaternionManifold()
    for m in maps:
        i, j = m.reference, int(m.poses[0])
        problem.add_residual_block(_odometry(m), None, [q[i], t[i], q[j], t[j]])
        for k, landmark in enumerate(m.landmarks.tolist()):
            rows = slice(6 + 3 * k, 9 + 3 * k)
            cost = cost_functions.Point3DAlignmentCost(np.linalg.inv(m.information[rows, rows]), m.mean[rows])
            problem.add_residual_block(cost, None, [points[landmark], q[i], t[i], scale])
    for i in range(len(q)):
        problem.set_manifold(q[i], manifold)
    for block in (q[0], t[0], scale):
        problem.set_parameter_block_constant(block)
    return problem, q, t, points


def _odometry(m: LocalMap) -> Any:
    """The relative pose; its covariance is turned into the residual's own coordinates by differences."""
    prior = pycolmap.Rigid3d(make_transform(so3_exp(m.mean[3:6]), m.mean[:3])[:3])
    plain, step, J = cost_functions.RelativePosePriorCost(np.eye(6), prior), 1e-6, np.empty((6, 6))
    for k in range(6):
        ends = []
        for sign in (step, -step):
            e = np.zeros(6)
            e[k] = sign
            moved = Rotation.from_matrix(so3_exp(e[3:]) @ so3_exp(m.mean[3:6])).inv()
            end = moved.as_quat(), -moved.apply(m.mean[:3] + e[:3])
            ends.append(np.ravel(plain.evaluate(np.array([0, 0, 0, 1.0]), np.zeros(3), *end)[0]))
        J[:, k] = (ends[0] - ends[1]) / (2 * step)
    return cost_functions.RelativePosePriorCost(J @ np.linalg.inv(m.information[:6, :6]) @ J.T, prior)
