# SPDX-License-Identifier: Apache-2.0
"""One least-squares problem over all pictures: lenses, camera positions in the rig, and the board's pose in each view.

Minimises the reprojection error of every corner under Huber's loss by Levenberg-Marquardt. A board pose touches the
corners of its own view only, so it is eliminated view by view (Schur complement) and the system solved has the size of
the rig: some ten unknowns per camera. The inverse of that reduced information, scaled by the residual variance, is the
covariance of the calibration (thesis Tables 2.1-2.3; Triggs et al. 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam_calibration.detection import Corners
from slam_calibration.lens import camera_from_parameters, parameter_names, project_with_jacobians
from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxplus, skew, transform_points

POSE = 6
_PIXEL = 0.15
"""Noise of a corner (px) that a prior is weighed against."""

Views = Sequence[Sequence[Corners]]
"""``views[v][c]``: what camera c saw of the board in view v; empty where it saw nothing."""


@dataclass(frozen=True)
class BundleConfig(Config):
    """Settings of the bundle adjustment."""

    huber_px: float = parameter(1.0, "residual beyond which a corner's pull no longer grows", unit="px", minimum=0.01)
    distortion_prior: float = parameter(
        1.0,
        "standard deviation of a distortion coefficient before any picture: without effect on what the pictures show, "
        "it keeps coefficients that cancel each other (rational_polynomial) from running away together",
        minimum=1e-3,
    )
    maximum_iterations: int = parameter(100, "Levenberg-Marquardt steps", minimum=1)
    tolerance: float = parameter(1e-10, "relative decrease of the cost that ends the iteration", minimum=1e-15)


@dataclass(frozen=True, eq=False)
class LensState:
    """One camera of the rig: its lens and ``T`` = T_camera_first, from the first camera's optical frame to its own."""

    lens: str
    width: int
    height: int
    parameters: FloatArray
    T: FloatArray

    @property
    def camera(self) -> Camera:
        """The camera model."""
        return camera_from_parameters(self.lens, self.width, self.height, self.parameters)


@dataclass(frozen=True, eq=False)
class Rig:
    """Estimated quantities: cameras, and per view ``T_first_board`` (4, 4)."""

    cameras: tuple[LensState, ...]
    board_poses: tuple[FloatArray, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rig's parameters, ``camera index.parameter``, in the order of the covariance."""
        names = [f"{c}.{name}" for c, state in enumerate(self.cameras) for name in parameter_names(state.lens)]
        names += [f"{c}.{axis}" for c in range(1, len(self.cameras)) for axis in ("x", "y", "z", "rx", "ry", "rz")]
        return tuple(names)


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The adjusted rig.

    views: the corners used, by ``[view][camera]``.
    covariance: of the rig's parameters (``rig.names``), in px, m, rad; board poses are marginalised. residuals: (n, 2)
    px measured minus predicted, by ``[view][camera]``, empty where the camera saw nothing. rms: root mean square length
    of the corners' residual vectors, px, as OpenCV reports it.
    """

    rig: Rig
    views: Views
    covariance: FloatArray
    residuals: tuple[tuple[FloatArray, ...], ...]
    rms: float
    iterations: int
    converged: bool

    def standard_deviation(self, name: str) -> float:
        """Standard deviation of the parameter ``name`` of ``rig.names``."""
        index = self.rig.names.index(name)
        return float(np.sqrt(self.covariance[index, index]))


def adjust(board_points: FloatArray, views: Views, start: Rig, config: BundleConfig | None = None) -> BundleResult:
    """Adjust a rig to its views.

    Parameters
    ----------
    board_points
        Corners on the board by id, shape (n, 3), m.
    views
        Corners seen, by view and camera; the pose of a view that nobody saw is left as it is.
    start
        Rough rig, with one board pose per view.
    config
        Settings; None: the defaults.
    """
    config = config or BundleConfig()
    rig, damping = start, 1e-3
    system = _linearise(board_points, views, rig, config)
    iteration, converged = 0, False
    while not converged and iteration < config.maximum_iterations:
        iteration += 1
        candidate = _step(rig, system, damping)
        cost = _cost(board_points, views, candidate, config)
        if np.isfinite(cost) and cost <= system.cost:
            converged = system.cost - cost <= config.tolerance * (system.cost + 1e-3)
            rig, damping = candidate, max(0.1 * damping, 1e-12)
            system = _linearise(board_points, views, rig, config)
        else:
            converged = damping > 1e8
            damping *= 10.0
    return _result(board_points, views, rig, system, iteration, converged and damping < 1e8)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations: rig block A, per view the coupling B, own block C, and both gradients."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    g_rig: FloatArray
    g_views: FloatArray
    cost: float
    weighted_squares: float
    weight: float


def _linearise(board_points: FloatArray, views: Views, rig: Rig, config: BundleConfig) -> _System:
    n, v = len(rig.names), len(views)
    B, C, g_views = np.zeros((v, n, POSE)), np.zeros((v, POSE, POSE)), np.zeros((v, POSE))
    A, g_rig, cost = _prior(rig, config)
    weighted_squares = weight = 0.0
    for index, c, corners in _seen(views):
        residual, J_rig, J_pose = _residual_with_jacobians(board_points, corners, rig, index, c)
        w, loss = _huber(residual, config.huber_px)
        J_rig, J_pose, r = J_rig.reshape(-1, n), J_pose.reshape(-1, POSE), residual.ravel()
        w2 = np.repeat(w, 2)[:, None]
        A += J_rig.T @ (w2 * J_rig)
        B[index] += J_rig.T @ (w2 * J_pose)
        C[index] += J_pose.T @ (w2 * J_pose)
        g_rig += J_rig.T @ (w2[:, 0] * r)
        g_views[index] += J_pose.T @ (w2[:, 0] * r)
        cost += loss
        weighted_squares += float(w2[:, 0] @ r**2)
        weight += float(w2.sum())
    C[[not any(len(k) for k in view) for view in views]] = np.eye(POSE)
    return _System(A, B, C, g_rig, g_views, cost, weighted_squares, weight)


def _step(rig: Rig, system: _System, damping: float) -> Rig:
    C = system.C * (1.0 + damping * np.eye(POSE))
    A = system.A + damping * np.diag(np.diag(system.A))
    BC = np.linalg.solve(C, np.swapaxes(system.B, 1, 2))  # C^-1 B^T, (v, 6, n)
    reduced = A - np.einsum("vij,vjk->ik", system.B, BC)
    right = system.g_rig - np.einsum("vji,vj->i", BC, system.g_views)
    d_rig = np.linalg.lstsq(reduced, right, rcond=None)[0]
    d_views = np.linalg.solve(C, (system.g_views - np.einsum("vij,i->vj", system.B, d_rig))[..., None])[..., 0]
    return _moved(rig, d_rig, d_views)


def _moved(rig: Rig, d_rig: FloatArray, d_views: FloatArray) -> Rig:
    cameras, at = [], 0
    for state in rig.cameras:
        size = len(state.parameters)
        cameras.append(replace(state, parameters=state.parameters + d_rig[at : at + size]))
        at += size
    for c in range(1, len(cameras)):
        cameras[c] = replace(cameras[c], T=boxplus(cameras[c].T, d_rig[at : at + POSE]))
        at += POSE
    poses = tuple(boxplus(T, d) for T, d in zip(rig.board_poses, d_views, strict=True))
    return Rig(tuple(cameras), poses)


def _residual_with_jacobians(
    board_points: FloatArray, corners: Corners, rig: Rig, view: int, c: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measured minus predicted (n, 2); derivatives of the prediction by rig (n, 2, k) and board pose (n, 2, 6)."""
    state, T_first_board = rig.cameras[c], rig.board_poses[view]
    first = transform_points(T_first_board, board_points[corners.ids])
    point = transform_points(state.T, first)
    pixels, J_point, J_lens = project_with_jacobians(state.lens, state.parameters, point)
    J_rig = np.zeros((len(corners), 2, len(rig.names)))
    at = sum(len(other.parameters) for other in rig.cameras[:c])
    J_rig[:, :, at : at + len(state.parameters)] = J_lens
    R = state.T[:3, :3]
    if c > 0:
        at = sum(len(other.parameters) for other in rig.cameras) + POSE * (c - 1)
        J_rig[:, :, at : at + POSE] = J_point @ _point_by_pose(first @ R.T)
    J_pose = J_point @ R @ _point_by_pose(first - T_first_board[:3, 3])
    return corners.pixels - pixels, J_rig, J_pose


def _point_by_pose(rotated: FloatArray) -> FloatArray:
    """Derivative (n, 3, 6) of ``T p`` by the error of T, ``rotated`` = R p (n, 3)."""
    J = np.zeros((len(rotated), 3, POSE))
    J[:, :, :3] = np.eye(3)
    J[:, :, 3:] = -skew(rotated)
    return J


def _seen(views: Views) -> list[tuple[int, int, Corners]]:
    return [(v, c, corners) for v, view in enumerate(views) for c, corners in enumerate(view) if len(corners)]


def _residuals(board_points: FloatArray, corners: Corners, rig: Rig, view: int, c: int) -> FloatArray:
    state = rig.cameras[c]
    point = transform_points(state.T @ rig.board_poses[view], board_points[corners.ids])
    if (point[:, 2] <= 1e-6).any():
        return np.full((len(corners), 2), np.inf)  # the board passed behind the camera: the step is refused
    return corners.pixels - project_with_jacobians(state.lens, state.parameters, point)[0]


def _prior(rig: Rig, config: BundleConfig) -> tuple[FloatArray, FloatArray, float]:
    """Information, gradient and cost of the prior on the distortion coefficients."""
    values = np.concatenate([np.concatenate([np.zeros(4), state.parameters[4:]]) for state in rig.cameras])
    mask = np.concatenate([np.arange(len(state.parameters)) >= 4 for state in rig.cameras])
    poses = np.zeros(len(rig.names) - len(values))
    weight = (_PIXEL / config.distortion_prior) ** 2
    information = weight * np.concatenate([mask, poses])
    return np.diag(information), -weight * np.concatenate([values, poses]), 0.5 * weight * float(values @ values)


def _cost(board_points: FloatArray, views: Views, rig: Rig, config: BundleConfig) -> float:
    return _prior(rig, config)[2] + sum(
        _huber(_residuals(board_points, k, rig, v, c), config.huber_px)[1] for v, c, k in _seen(views)
    )


def _huber(residual: FloatArray, threshold: float) -> tuple[FloatArray, float]:
    """Weights (n,) and total loss of residual vectors (n, 2); Huber (1964)."""
    length = np.linalg.norm(residual, axis=1)
    w = np.minimum(1.0, threshold / np.maximum(length, 1e-12))
    loss = np.where(length <= threshold, 0.5 * length**2, threshold * (length - 0.5 * threshold))
    return w, float(loss.sum())


def _result(
    board_points: FloatArray, views: Views, rig: Rig, system: _System, iterations: int, converged: bool
) -> BundleResult:
    reduced = system.A - np.einsum("vij,vjk->ik", system.B, np.linalg.solve(system.C, np.swapaxes(system.B, 1, 2)))
    posed = sum(any(len(k) for k in view) for view in views)
    freedom = max(system.weight - len(rig.names) - POSE * posed, 1.0)
    covariance = _inverse(reduced) * (system.weighted_squares / freedom)
    residuals = tuple(
        tuple(_residuals(board_points, k, rig, v, c) for c, k in enumerate(view)) for v, view in enumerate(views)
    )
    stacked = np.concatenate([r for view in residuals for r in view])
    rms = float(np.sqrt(np.square(stacked).sum(axis=1).mean()))
    return BundleResult(rig, views, covariance, residuals, rms, iterations, converged)


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse of a symmetric matrix with a diagonal of many orders; no information becomes a huge variance."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T
    return np.asarray(inverse * np.outer(scale, scale))
