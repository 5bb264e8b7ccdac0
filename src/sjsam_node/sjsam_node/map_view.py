"""The joined map as others want it: trajectories and landmarks with exact marginal covariances.

The poses inside a submap hang on the joined skeleton: what joining changed at the submap's end is handed to each pose
by the gain with which the end, once known better, corrects it (a Rauch-Tung-Striebel step with the submap's own
covariances).

Submaps that contradict one another more than they claim possible are too sure of themselves, each as much as the
others as far as the map can tell: every covariance that goes out is multiplied by the component's variance factor, chi2
per degree of freedom (the "variance of unit weight"; Baarda 1968), never below one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sjsam_node.estimator import Assembled, ReducedMap
from sjsam_node.joining import Marginals
from sjsam_node.map_graph import MapGraph, Record
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    compose_jacobians,
    inverse_jacobian,
    invert_transform,
    skew,
)  # fmt: skip
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.types import Float32Array, PoseEstimate, Submap

if TYPE_CHECKING:
    from sjsam_node.global_map import GlobalMap


@dataclass(frozen=True, eq=False)
class MapLandmarks:
    """Landmarks of the map frame: ids (n,), positions (n, 3) m, covariances (n, 3, 3), descriptors (n, d), sightings
    (n,).

    ``linked`` (n,) bool: whether the landmark hangs on the map's own component; the frame of others is arbitrary.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray
    descriptors: Float32Array
    sightings: IntArray
    linked: FloatArray


def trajectory(global_map: GlobalMap) -> dict[str, list[PoseEstimate]]:
    """Poses of every agent, in the order of their stamps.

    A component that nothing ties to the map yet is given in its own frame, laid where its agent was last seen, and its
    covariances are widened by ``unlinked_sigma``: a receiver sees that these poses mean nothing in the map frame.
    """
    out: dict[str, list[PoseEstimate]] = {}
    for part in _components(global_map):
        for i in part.assembled.records:
            record = global_map.graph.records[i]
            joint = part.marginals.covariance(np.searchsorted(part.assembled.nodes, [record.start, record.end]))
            poses = _hung(global_map.graph, record, joint)
            out.setdefault(record.submap.agent, []).extend(
                PoseEstimate(p.stamp_ns, p.T, part.factor * p.covariance + part.widening) for p in poses
            )
    return {agent: _unique_stamps(poses) for agent, poses in sorted(out.items())}


@dataclass(frozen=True, eq=False)
class _Part:
    """A component with what its covariances are multiplied by, and what is added (6, 6) where its frame is unknown."""

    assembled: Assembled
    marginals: Marginals
    factor: float
    widening: FloatArray


def _components(global_map: GlobalMap) -> list[_Part]:
    graph = global_map.graph
    if not graph.records:
        return []
    main = int(graph.component_of[graph.records[0].start])
    out = []
    for component in np.unique(graph.component_of).tolist():
        assembled = global_map.assembled(component)
        widening = np.zeros((6, 6)) if component == main else _unknown(global_map.config.unlinked_sigma)
        marginals = assembled.problem.marginals(assembled.state)
        out.append(_Part(assembled, marginals, global_map.joiner.variance_factor(component), widening))
    return out


def _unknown(sigma: float) -> FloatArray:
    """Covariance (6, 6) of a frame of which nothing is known: position by ``sigma`` m, orientation by half a turn."""
    return np.diag(np.square([sigma, sigma, sigma, np.pi, np.pi, np.pi]))


def _unique_stamps(poses: list[PoseEstimate]) -> list[PoseEstimate]:
    """Sorted by stamp; where a submap ends and the next begins, the pose is given once."""
    return [poses[i] for i in np.unique([p.stamp_ns for p in poses], return_index=True)[1]]


def _hung(graph: MapGraph, record: Record, joint: FloatArray) -> list[PoseEstimate]:
    """The poses inside a submap on the joined skeleton; ``joint`` (12, 12) of its start and end node."""
    T_start, T_end = graph.poses[record.start], graph.poses[record.end]
    T_inverse = invert_transform(T_start)
    correction = boxminus(T_inverse @ T_end, record.submap.end_pose)
    J_inverse, J_end = compose_jacobians(T_inverse, T_end)
    D = np.concatenate([J_inverse @ inverse_jacobian(T_start), J_end], axis=1)
    out = []
    for pose in record.submap.path:
        gain, remaining = _smoothing(record.submap, pose)
        T = boxplus(pose.T, gain @ correction)
        J_start, J_pose = compose_jacobians(T_start, T)
        J = J_pose @ gain @ D
        J[:, :6] += J_start
        covariance = J @ joint @ J.T + J_pose @ remaining @ J_pose.T
        out.append(PoseEstimate(pose.stamp_ns, T_start @ T, _positive(covariance)))  # the map's first pose has none
    return out


def _smoothing(submap: Submap, pose: PoseEstimate) -> tuple[FloatArray, FloatArray]:
    """Gain (6, 6) by which a better end corrects a pose of the path, and the covariance (6, 6) of what it leaves.

    A pose errs by what it hands on to the end, and by the noise of its own frame's measurement, which the end does not
    share. The first pose after the start shows the size of the latter: its covariance is that of two frames.
    """
    end_covariance = submap.covariance[:6, :6]
    if pose.stamp_ns == submap.end_stamp_ns:
        return np.eye(6), np.zeros((6, 6))
    if pose.stamp_ns == submap.start_stamp_ns:
        return np.zeros((6, 6)), np.zeros((6, 6))
    handed_on = _positive(pose.covariance - 0.5 * submap.path[1].covariance)
    A = np.eye(6)  # the lever arm of what is left of the way
    A[:3, 3:] = -skew(submap.end_pose[:3, 3] - pose.T[:3, 3])
    gain = np.asarray(np.linalg.solve(end_covariance, A @ handed_on).T, dtype=np.float64)
    return gain, _positive(pose.covariance - gain @ end_covariance @ gain.T)


def _positive(covariance: FloatArray) -> FloatArray:
    """Nearest positive definite matrix: eigenvalues no smaller than nothing much."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.maximum(values, 1e-12)) @ vectors.T)


def landmarks(global_map: GlobalMap) -> MapLandmarks:
    """Every landmark once, from the submap that saw it last."""
    graph = global_map.graph
    covariances = np.zeros((len(graph.points), 3, 3))
    linked = np.zeros(len(graph.points), dtype=bool)
    for part in _components(global_map):
        for i, reduced in zip(part.assembled.records, part.assembled.reduced, strict=True):
            record = graph.records[i]
            rows = record.observations
            own = _observation_covariances(graph, record, reduced, part.assembled, part.marginals)
            covariances[rows] = part.factor * own + part.widening[:3, :3]
            linked[rows] = part.widening[0, 0] == 0.0
    ids, counts = np.unique(graph.landmark_of, return_counts=True)
    newest = np.empty(len(graph.points), dtype=np.int64)
    newest[graph.landmark_of] = np.arange(len(graph.points))
    descriptors = [r.submap.descriptors for r in graph.records]
    stacked = np.concatenate(descriptors) if descriptors else np.empty((0, 0), np.float32)
    rows = newest[ids]
    return MapLandmarks(ids, graph.points[ids], covariances[rows], stacked[rows], counts, linked[rows])


def _observation_covariances(
    graph: MapGraph, record: Record, reduced: ReducedMap, assembled: Assembled, marginals: Marginals
) -> FloatArray:
    """Covariance (n, 3, 3) in the map frame of each landmark of a record."""
    nodes = np.searchsorted(assembled.nodes, [record.start, record.end])
    shared = np.searchsorted(assembled.landmarks, graph.landmark_of[record.observations[reduced.shared]])
    joint = marginals.covariance(nodes, shared)
    out = np.empty((len(record.observations), 3, 3))
    k = np.arange(len(shared))
    out[reduced.shared] = joint[12:, 12:].reshape(len(k), 3, len(k), 3)[k, :, k, :]
    R = graph.poses[record.start][:3, :3]
    J = _private_jacobian(graph, record, reduced)
    out[reduced.private] = np.einsum("pim,mn,pjn->pij", J, joint, J, optimize=True) + R @ reduced.spread @ R.T
    return out


def _private_jacobian(graph: MapGraph, record: Record, reduced: ReducedMap) -> FloatArray:
    """Derivative (p, 3, 12 + 3k) of private landmarks, in the map, by start, end and shared landmarks."""
    T_start, T_end = graph.poses[record.start], graph.poses[record.end]
    R, t = T_start[:3, :3], T_start[:3, 3]
    k, p = len(reduced.shared), len(reduced.private)
    points = graph.points[graph.landmark_of[record.observations[reduced.shared]]]
    residual_jacobian = np.zeros((6 + 3 * k, 12 + 3 * k))
    J_inverse, J_end = compose_jacobians(invert_transform(T_start), T_end)
    residual_jacobian[:6, :6], residual_jacobian[:6, 6:12] = J_inverse @ inverse_jacobian(T_start), J_end
    for n in range(k):
        row = slice(6 + 3 * n, 9 + 3 * n)
        residual_jacobian[row, :3] = -R.T
        residual_jacobian[row, 3:6] = R.T @ skew(points[n] - t)
        residual_jacobian[row, 12 + 3 * n : 15 + 3 * n] = R.T
    moved = R @ (reduced.gain @ residual_jacobian).reshape(p, 3, 12 + 3 * k)
    moved[:, :, :3] += np.eye(3)
    moved[:, :, 3:6] -= skew(graph.points[record.observations[reduced.private]] - t)
    return np.asarray(moved)
