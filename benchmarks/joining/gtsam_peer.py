# SPDX-License-Identifier: Apache-2.0
"""The joining problem of block rows in GTSAM's own factors: batch LM, joint covariances, iSAM2."""

from __future__ import annotations

import time
from typing import Any

import gtsam
import numpy as np
from memory import PeakMemory

from sjsam_node.joint_problem.problem import JoiningState, LocalMap
from slam_core.geometry import make_transform, so3_exp

X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


def solve(maps: list[LocalMap], state: JoiningState, repeat: int) -> dict[str, Any]:
    """Batch Levenberg-Marquardt with its default parameters, and the joint covariance of eight poses."""
    graph, values = graph_of(maps, state)
    memory, times, covariances, solution = PeakMemory(), [], [], values
    for _ in range(repeat):
        began = time.perf_counter()
        solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        times.append(time.perf_counter() - began)
    grown = memory.grown()
    keys = [X(int(i)) for i in np.linspace(1, len(state.translations) - 1, 8)]
    for _ in range(repeat):
        began = time.perf_counter()
        gtsam.Marginals(graph, solution).jointMarginalCovariance(keys)
        covariances.append(time.perf_counter() - began)
    return {"batch": times, "covariances": covariances, "memory": grown, "state": _state_of(solution, state)}


def isam2(maps: list[LocalMap], state: JoiningState, repeat: int) -> dict[str, Any]:
    """One submap after the other with the estimate after each, default parameters; once, whatever ``repeat``."""
    del repeat
    memory, began = PeakMemory(), time.perf_counter()
    solver, known, estimate = gtsam.ISAM2(gtsam.ISAM2Params()), set[int](), gtsam.Values()
    for m in maps:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if m.reference == 0:
            graph.add(gtsam.PriorFactorPose3(X(0), _pose(state, 0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
            values.insert(X(0), _pose(state, 0))
        start = _pose(state, 0) if m.reference == 0 else estimate.atPose3(X(m.reference))
        step = gtsam.Pose3(make_transform(so3_exp(m.mean[3:6]), m.mean[:3]))
        values.insert(X(int(m.poses[0])), start.compose(step))
        for k, landmark in enumerate(m.landmarks.tolist()):
            if landmark not in known:
                known.add(landmark)
                values.insert(L(landmark), start.transformFrom(m.mean[6 + 3 * k : 9 + 3 * k]))
        for factor in _factors_of(m):
            graph.add(factor)
        solver.update(graph, values)
        estimate = solver.calculateEstimate()
    seconds = time.perf_counter() - began
    return {"batch": [seconds], "memory": memory.grown(), "state": _state_of(estimate, state)}


def graph_of(maps: list[LocalMap], state: JoiningState) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same block rows as GTSAM's own factors. Its poses move in the body frame, rotation first."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(X(0), _pose(state, 0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for i in range(len(state.translations)):
        values.insert(X(i), _pose(state, i))
    for i, point in enumerate(state.landmarks):
        values.insert(L(i), point)
    for m in maps:
        for factor in _factors_of(m):
            graph.add(factor)
    return graph, values


def _factors_of(m: LocalMap) -> list[gtsam.NonlinearFactor]:
    R = so3_exp(m.mean[3:6])
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = R
    noise = gtsam.noiseModel.Gaussian.Information(turn.T @ m.information[:6, :6] @ turn)
    out = [
        gtsam.BetweenFactorPose3(X(m.reference), X(int(m.poses[0])), gtsam.Pose3(make_transform(R, m.mean[:3])), noise)
    ]
    for k, landmark in enumerate(m.landmarks):
        rows = slice(6 + 3 * k, 9 + 3 * k)
        out.append(_sighting(m.reference, int(landmark), m.mean[rows], m.information[rows, rows]))
    return out


def _sighting(pose: int, landmark: int, point: np.ndarray, information: np.ndarray) -> gtsam.NonlinearFactor:
    """A point in the pose's frame. GTSAM's Python has no such factor: as bearing and range, the same to first order."""
    distance = float(np.linalg.norm(point))
    bearing = gtsam.Unit3(point)
    J = np.vstack([bearing.basis().T / distance, point / distance])
    noise = gtsam.noiseModel.Gaussian.Covariance(J @ np.linalg.inv(information) @ J.T)
    return gtsam.BearingRangeFactor3D(X(pose), L(landmark), bearing, distance, noise)


def _pose(state: JoiningState, i: int) -> gtsam.Pose3:
    return gtsam.Pose3(make_transform(state.rotations[i], state.translations[i]))


def _state_of(values: gtsam.Values, like: JoiningState) -> JoiningState:
    poses = np.array([values.atPose3(X(i)).matrix() for i in range(len(like.translations))])
    points = [values.atPoint3(L(i)) for i in range(len(like.landmarks))]
    return JoiningState(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), np.array(points))
