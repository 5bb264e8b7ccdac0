# SPDX-License-Identifier: Apache-2.0
"""Small joining problems with random values, 2D and 3D."""

from __future__ import annotations

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import JoiningState, LocalMap
from slam_core.geometry import boxminus, euler_from_rotation, make_transform, so3_exp

MODELS = {"planar": kernels.PLANAR, "tangent": kernels.TANGENT, "euler": kernels.EULER}


def random_problem(
    model: int, rng: np.random.Generator, maps: int = 5, landmarks: int = 7
) -> tuple[list[LocalMap], JoiningState]:
    """A chain of noisy local maps, each seeing some of the landmarks; the last one also holds an older pose."""
    d, a = (2, 1) if model == kernels.PLANAR else (3, 3)
    P = maps + 1
    v = np.zeros((P, 3))
    v[:, 3 - a :] = rng.normal(0, 0.4, (P, a))
    R = so3_exp(v)[:, :d, :d]
    t, points = rng.normal(0, 2, (P, d)), rng.normal(0, 4, (landmarks, d))
    out = []
    for k in range(maps):
        seen = np.sort(rng.choice(landmarks, 4, replace=False))
        poses = np.array([k + 1]) if k < maps - 1 else np.array([k + 1, 0])
        mean = np.concatenate(
            [measured_pose(model, R[k], t[k], R[j], t[j]) for j in poses] + [((points[seen] - t[k]) @ R[k]).ravel()]
        )
        root = rng.normal(size=(len(mean),) * 2)
        mean = mean + 0.02 * rng.normal(size=len(mean))
        out.append(LocalMap(k, poses, seen, mean, 100.0 * (root @ root.T + 5.0 * np.eye(len(mean)))))
    return out, JoiningState(np.ascontiguousarray(R), t, points)


def measured_pose(model: int, Ri: np.ndarray, ti: np.ndarray, Rj: np.ndarray, tj: np.ndarray) -> np.ndarray:
    relative = Ri.T @ Rj
    if model == kernels.PLANAR:
        angle = np.array([np.arctan2(relative[1, 0], relative[0, 0])])
    elif model == kernels.EULER:
        angle = euler_from_rotation(relative)
    else:
        angle = boxminus(make_transform(relative, np.zeros(3)), np.eye(4))[3:]
    return np.concatenate([Ri.T @ (tj - ti), angle])


def perturbed(problem: JoiningProblem, s: JoiningState, rng: np.random.Generator, size: float = 0.1) -> JoiningState:
    return problem.retract(s, size * rng.normal(size=problem.layout.pattern.n))
