# SPDX-License-Identifier: Apache-2.0
"""Monte-Carlo runs of the estimator on simulated features, and what its errors say about its covariances."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.slam import EkfSlam
from feature_world import PointWorld, room
from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import FloatArray, boxminus, invert_transform, skew, transform_points
from slam_core.types import PoseEstimate, Submap

STEP_NS = 100_000_000


@dataclass(frozen=True, eq=False)
class SubmapErrors:
    """Error (6 + 3n,) of one submap's joint Gaussian (end pose, landmarks) and its covariance; nobody left out."""

    submap: Submap
    error: FloatArray

    @property
    def joint_nees(self) -> float:
        """Per degree of freedom."""
        return float(nees(self.error, self.submap.covariance)) / len(self.error)

    @property
    def pose_nees(self) -> float:
        """Of the end pose, 6 degrees of freedom."""
        return float(nees(self.error[:6], self.submap.covariance[:6, :6]))

    @property
    def landmark_nees(self) -> float:
        """Mean over the landmarks, 3 degrees of freedom each."""
        n = len(self.submap.landmarks)
        blocks = self.submap.covariance[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        return float(nees(self.error[6:].reshape(n, 3), blocks).mean())


@dataclass(frozen=True, eq=False)
class Run:
    """One run: errors of its submaps, NEES (k,) of the poses inside the first submap, the sum of all NIS, its degrees
    of freedom and the number of updates, error (6,) of the last pose of all and its covariance (6, 6), and the
    processor time (n,) that the estimator took for each frame, ms.
    """

    submaps: list[SubmapErrors]
    pose_nees: FloatArray
    nis: float
    nis_dof: int
    updates: int
    end_error: FloatArray
    end_covariance: FloatArray
    ms: FloatArray


def mean_nis(runs: list[Run], gate: float, own_motion: bool) -> tuple[float, float, float]:
    """Mean NIS per degree of freedom of all runs and its bounds (95 %).

    What a gate lets through is a truncated chi-square: ``E[x | x < g] = n F_n+2(g) / F_n(g)`` for n degrees of
    freedom. And in the six directions in which the motion since the last frame moves an update's innovations, those of
    a rig that moves more smoothly than the filter's model may be as small as zero; of one that follows the model
    (``own_motion``) they are not.
    """
    dof, updates = sum(run.nis_dof for run in runs), sum(run.updates for run in runs)
    passed = float(chi2.cdf(gate, 5) / chi2.cdf(gate, 3))
    low, high = anees_bounds(1, dof)
    smooth = 0.0 if own_motion else 6.0 * updates / dof
    return sum(run.nis for run in runs) / dof, low * passed * (1.0 - smooth), high * passed


def simulate(
    seed: int,
    config: EkfSlamConfig,
    make_poses: Callable[[np.random.Generator], list[FloatArray]],
    make_world: Callable[[np.random.Generator], PointWorld] = room,
) -> Run:
    """Run the estimator through a random world along the poses T_world_rig, 10 frames per second."""
    rng = np.random.default_rng(seed)
    world, poses = make_world(rng), make_poses(rng)
    slam = EkfSlam(config)
    names: dict[int, list[int]] = {}
    submaps: list[Submap] = []
    nis, dof, updates, ms = 0.0, 0, 0, np.zeros(len(poses))
    for k, T in enumerate(poses):
        features, index = world.features(T, k * STEP_NS, rng)
        start = time.process_time()
        result = slam.process(features)
        ms[k] = 1e3 * (time.process_time() - start)
        submaps += result.submaps
        nis, dof, updates = nis + result.nis, dof + result.nis_dof, updates + (result.nis_dof > 0)
        for landmark, feature in zip(result.landmark_ids, result.feature_index, strict=True):
            names.setdefault(int(landmark), []).append(int(index[feature]))
    submaps += slam.finish()
    errors = [_errors(submap, world, poses, names) for submap in submaps]
    end = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
    return Run(errors, _pose_nees(submaps[0].path, poses), nis, dof, updates, end, result.pose.covariance, ms)


def _errors(submap: Submap, world: PointWorld, poses: list[FloatArray], names: dict[int, list[int]]) -> SubmapErrors:
    start, end = poses[submap.start_stamp_ns // STEP_NS], poses[submap.end_stamp_ns // STEP_NS]
    to_submap = invert_transform(start)
    known = np.flatnonzero([int(i) in names for i in submap.landmark_ids])
    which = [max(set(names[i]), key=names[i].count) for i in submap.landmark_ids[known].tolist()]
    truth = transform_points(to_submap, world.points[which])
    pose = boxminus(to_submap @ end, submap.end_pose)
    part = _part(submap, known)
    return SubmapErrors(part, np.concatenate([pose, (truth - part.landmarks).ravel()]))


def _part(submap: Submap, index: np.ndarray) -> Submap:
    """The submap with these landmarks alone: those never measured again have no known truth."""
    rows = np.concatenate([np.arange(6), (6 + 3 * index[:, None] + np.arange(3)).ravel()])
    return replace(
        submap,
        landmarks=submap.landmarks[index],
        covariance=submap.covariance[np.ix_(rows, rows)],
        landmark_ids=submap.landmark_ids[index],
        sightings=submap.sightings[index],
        descriptors=submap.descriptors[index],
    )


def _pose_nees(path: tuple[PoseEstimate, ...], poses: list[FloatArray]) -> FloatArray:
    origin = invert_transform(poses[path[0].stamp_ns // STEP_NS])
    errors = np.array([boxminus(origin @ poses[p.stamp_ns // STEP_NS], p.T) for p in path[1:]])
    return nees(errors, np.array([p.covariance for p in path[1:]]))


def seam_nees(before: Submap, after: Submap) -> float:
    """NEES per degree of freedom of two consecutive submaps' disagreement about the landmarks they share.

    Submaps that share information agree better than two independent ones may: then it falls below one.
    """
    _, i, j = np.intersect1d(before.landmark_ids, after.landmark_ids, return_indices=True)
    R, n = before.end_pose[:3, :3], len(i)
    moved = transform_points(before.end_pose, after.landmarks[j])
    rows = (6 + 3 * i[:, None] + np.arange(3)).ravel()
    J = np.zeros((3 * n, 6 + 3 * len(before.landmarks)))
    J[np.arange(3 * n), rows] = 1.0
    J[:, :6] = -np.concatenate(
        [np.broadcast_to(np.eye(3), (n, 3, 3)), -skew(moved - before.end_pose[:3, 3])], axis=2
    ).reshape(3 * n, 6)
    own = (6 + 3 * j[:, None] + np.arange(3)).ravel()
    turn = np.kron(np.eye(n), R)
    S = J @ before.covariance @ J.T + turn @ after.covariance[np.ix_(own, own)] @ turn.T
    return float(nees((before.landmarks[i] - moved).ravel(), S)) / (3 * n)
