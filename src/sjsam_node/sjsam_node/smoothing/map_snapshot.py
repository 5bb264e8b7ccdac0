# SPDX-License-Identifier: Apache-2.0
"""A snapshot of the joined map for those who read it: structure, paths, trajectories, landmarks, with covariances.

The poses inside a submap hang on the joined skeleton: what joining changed at the submap's end moves each pose by the
gain with which the end, once known better, corrects it (a Rauch-Tung-Striebel step with the submap's own covariances).

Submaps that contradict one another more than they claim possible are too sure of themselves, each as much as the
others as far as the map can tell: every covariance that goes out is multiplied by the component's variance factor, chi2
per degree of freedom (the "variance of unit weight"; Baarda 1968), never below one. What the cameras' calibration errs
by, common to all submaps, is added to what goes out and nowhere else (:mod:`slam_core.estimation.calibration_error`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.graph.map_graph import POSITIONS, BoolArray, MapGraph, Record
from sjsam_node.graph.marks import Marks
from sjsam_node.graph.position_ids import is_position_id
from sjsam_node.smoothing.inner_poses import positive, smoothing_gains, transposed
from sjsam_node.smoothing.marginals import ComponentMarginals
from sjsam_node.smoothing.state import EstimateState
from slam_core.estimation.calibration_error import (
    CalibrationErrorConfig,
    covariance_of_calibration,
    point_covariances_of_calibration,
)
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    compose_covariance,
    compose_jacobians,
    inverse_jacobian,
    invert_transform,
)
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.types import ORIGIN_SIGMA, Float32Array, PoseEstimate, Submap

ADVICE = (
    "Poses are as much less certain. The calibration may not fit: slam doctor BAG tells; slam calibrate "
    "refine BAG corrects that of a stereo pair, --odometry ndt helps a depth camera"
)
"""Advice to a user whose submaps contradict each other."""

STILL = 0.003, 0.001
"""Movement (m, rad) that a path need not show."""


@dataclass(frozen=True, eq=False)
class MapLandmarks:
    """Landmarks of the map frame.

    Ids (n,), positions (n, 3) m, covariances (n, 3, 3), descriptors (n, d), sightings (n,).

    ``linked`` (n,) bool: whether the landmark hangs on the map's own component; the frame of others is arbitrary.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray
    descriptors: Float32Array
    sightings: IntArray
    linked: BoolArray


@dataclass(frozen=True, eq=False)
class _Stacked:
    """The poses inside all submaps so far that show how an agent moved, how many each has, and the ends' gains."""

    count: list[int]
    inside: list[PoseEstimate]
    poses: FloatArray
    gains: FloatArray

    def with_one(self, submap: Submap) -> _Stacked:
        kept = _moving(submap.path)
        poses = np.concatenate([self.poses, [p.T for p in kept]])
        gains = np.concatenate([self.gains, smoothing_gains(submap, kept)[0]])
        return _Stacked([*self.count, len(kept)], [*self.inside, *kept], poses, gains)


class InnerPaths:
    """Constant parts of the poses inside submaps, kept from one snapshot to the next."""

    def __init__(self) -> None:
        self._stacked = _Stacked([], [], np.empty((0, 4, 4)), np.empty((0, 6, 6)))

    def of(self, records: Sequence[Record]) -> _Stacked:
        """That of the first records so far, and more."""
        stacked = self._stacked
        for record in records[len(stacked.count) :]:
            stacked = stacked.with_one(record.submap)
        self._stacked = stacked
        return stacked


@dataclass(frozen=True)
class MapSnapshot:
    """The map as of one update; it stays as it is while the map goes on.

    Attributes
    ----------
    unlinked_sigma, calibration
        What is added to covariances: in parts that nothing ties to the map (m), and for the cameras' calibration.
    marks
        The marks so far.
    """

    _state: EstimateState
    unlinked_sigma: float
    calibration: CalibrationErrorConfig = field(default_factory=CalibrationErrorConfig)
    marks: Marks = field(default_factory=Marks)
    _inner_paths: InnerPaths = field(default_factory=InnerPaths)

    # -- structure -----------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._state.graph.records)

    @property
    def submaps(self) -> tuple[Submap, ...]:
        """All submaps, in the order in which they were joined."""
        return tuple(r.submap for r in self._state.graph.records)

    @property
    def keys(self) -> list[tuple[str, int, int]]:
        """Agent, session and index of every submap."""
        return [r.key for r in self._state.graph.records]

    @property
    def poses(self) -> FloatArray:
        """T_map_node of all nodes of the skeleton, (nodes, 4, 4)."""
        return self._state.poses

    @property
    def nodes(self) -> IntArray:
        """Nodes at which the submaps start and end, (submaps, 2)."""
        return np.stack([self._state.graph.starts, self._state.graph.ends], axis=1)

    @property
    def closures(self) -> IntArray:
        """The two submaps of every closure, (closures, 2)."""
        ends = [k.ends for k in self._state.graph.links if k.is_closure]
        return np.array(ends, dtype=np.int64).reshape(-1, 2)

    @property
    def points(self) -> FloatArray:
        """Positions of every landmark of every submap in the map, (observations, 3) m, one submap after the other."""
        return self._state.points

    @property
    def submap_of(self) -> IntArray:
        """Submap of each of these observations, (observations,)."""
        return self._state.graph.record_of

    @property
    def landmark_of(self) -> IntArray:
        """Landmark of each of them, named after its oldest observation, (observations,)."""
        return self._state.graph.landmark_of

    @property
    def is_shared(self) -> BoolArray:
        """Mask (observations,) of those whose landmark more than one submap sees."""
        return self._state.graph.sets.is_shared

    @property
    def part_of(self) -> IntArray:
        """Part of the map that each submap is in, (submaps,): nothing ties two of them together yet."""
        return self._state.component_of[self._state.graph.starts]

    @property
    def is_tied(self) -> BoolArray:
        """Mask (submaps,) of those that hang together with the first one."""
        return np.asarray(self.part_of == self.part_of[:1])

    @property
    def components(self) -> int:
        """Parts of the map that nothing ties together yet."""
        return len(self._state.components())

    @property
    def overconfidence(self) -> str:
        """Warning if submaps contradict each other; empty if they do not."""
        factor, over = self._state.most_overconfident()
        if not over:
            return ""
        linked = {i for k in self._state.graph.links if not k.is_closure for i in k.ends}
        alone = sum(i not in linked for i in over)
        return (f"submaps contradict each other {factor:.0f} times more than they claim: "
                f"{alone} of {len(self)} are chained as the filter made them. {ADVICE}")  # fmt: skip

    def structure(self) -> MapSnapshot:
        """Snapshot without the factors that covariances come from, which are as large as the map."""
        return replace(self, _state=replace(self._state, solved={}, reduced={}, recovered={}))

    def skeleton_lines(self) -> FloatArray:
        """Start and end (n, 2, 3) m of every submap that cameras made."""
        return np.asarray(self.poses[self.nodes[~self.is_position]][:, :, :3, 3])

    def closure_lines(self) -> FloatArray:
        """Starts (closures, 2, 3) m of the two submaps of every closure."""
        return np.asarray(self.poses[self.nodes[self.closures, 0]][:, :, :3, 3])

    def mark_positions(self) -> FloatArray:
        """Marks in the map frame, (n, 3) m."""
        return self.marks.positions(self.poses)

    def start(self, record: int) -> PoseEstimate:
        """Start of a submap in the map frame, with covariance."""
        r = self._state.graph.records[record]
        return PoseEstimate(r.submap.start_stamp_ns, self.poses[r.start], self._covariance(r.start))

    def end(self, record: int) -> PoseEstimate:
        """End of a submap in the map frame, with covariance."""
        r = self._state.graph.records[record]
        return PoseEstimate(r.submap.end_stamp_ns, self.poses[r.end], self._covariance(r.end))

    @property
    def is_position(self) -> BoolArray:
        """Mask (submaps,) of those that cameras did not make: positions in a fixed frame."""
        return self._state.graph.is_position

    @property
    def submap_count(self) -> int:
        """Number of submaps that cameras made."""
        return int(np.count_nonzero(~self.is_position))

    @property
    def is_on_a_way(self) -> BoolArray:
        """Mask (nodes,) of those at which an agent was: a submap of positions starts and ends elsewhere."""
        out = np.ones(len(self.poses), dtype=np.bool_)
        out[self.nodes[self.is_position].ravel()] = False
        return out

    @property
    def newest_place(self) -> FloatArray:
        """End (3,) m of the submap that came last; the origin of an empty map."""
        return np.asarray(self.poses[self.is_on_a_way][-1:, :3, 3].sum(axis=0))

    def fixed_frame(self) -> PoseEstimate | None:
        """T_map_frame of the fixed frame that positions are in, with covariance, as of the last one; None without."""
        numbers = np.nonzero(self.is_position & self.is_tied)[0]
        if not len(numbers):
            return None
        start, submap = self.start(int(numbers[-1])), self.submaps[numbers[-1]]
        covariance = compose_covariance(start.T, start.covariance, submap.end_pose, np.zeros((6, 6)))
        return PoseEstimate(submap.end_stamp_ns, start.T @ submap.end_pose, covariance)

    # -- poses and landmarks -------------------------------------------------------------------------------------------

    def path(self) -> dict[str, list[PoseEstimate]]:
        """Poses of every agent in the order of their stamps, with no more covariance than inside their submaps.

        Of an agent that stands still there are few: a path through them is nowhere off by more than ``STILL``.
        """
        records = self._state.graph.records
        if not records:
            return {}
        stacked = self._inner_paths.of(records)
        of = np.repeat(np.arange(len(records)), stacked.count)
        poses = _on_skeleton(self.poses, records, of, stacked.poses, stacked.gains)
        parts: dict[str, list[PoseEstimate]] = {}
        agents = [r.submap.agent for r, n in zip(records, stacked.count, strict=True) for _ in range(n)]
        for agent, p, T in zip(agents, stacked.inside, poses, strict=True):
            parts.setdefault(agent, []).append(PoseEstimate(p.stamp_ns, T, p.covariance))
        return {agent: _unique_stamps(part) for agent, part in sorted(parts.items()) if not agent.startswith(POSITIONS)}

    def trajectory(self, since: int = 0) -> dict[str, list[PoseEstimate]]:
        """Poses of every agent in records from number ``since`` on, in the order of their stamps, with covariances.

        A component that nothing ties to the map yet is given in its own frame, laid where its agent was last seen, and
        its covariances are widened by ``unlinked_sigma``: a receiver sees that these poses mean nothing in the map
        frame.
        """
        out: dict[str, list[PoseEstimate]] = {}
        for component in self._state.components():
            marginals, widening = self._state.marginals(component), self._widening(component)
            for i in (i for i in marginals.records if i >= since and not self._state.graph.is_position[i]):
                record = self._state.graph.records[i]
                poses, covariances = _with_covariances(
                    self.poses, record, marginals, i, *smoothing_gains(record.submap, record.submap.path)
                )
                covariances += np.array([covariance_of_calibration(T, self.calibration) for T in poses])
                own = record.submap.path
                out.setdefault(record.submap.agent, []).extend(
                    PoseEstimate(p.stamp_ns, T, P + widening) for p, T, P in zip(own, poses, covariances, strict=True)
                )
        return {agent: _unique_stamps(poses) for agent, poses in sorted(out.items())}

    def _covariance(self, node: int) -> FloatArray:
        """Covariance (6, 6) of a node in the map frame."""
        component = int(self._state.component_of[node])
        common = covariance_of_calibration(self.poses[node], self.calibration)
        return self._state.marginals(component).node(node) + common + self._widening(component)

    def landmarks(self) -> MapLandmarks:
        """Every landmark once; what one submap alone saw counts only if that submap showed something new."""
        state, graph = self._state, self._state.graph
        ids, counts = np.unique(graph.landmark_of, return_counts=True)
        kept = (counts > 1) | ~state.redundant[graph.record_of[ids]]
        kept &= ~is_antenna(graph)[ids]
        ids, counts = ids[kept], counts[kept]
        rows = _estimated(graph)[ids]
        component = state.component_of[graph.starts[graph.record_of[rows]]]
        covariances = np.empty((len(ids), 3, 3))
        for c in np.unique(component).tolist():
            own = component == c
            covariances[own] = state.marginals(c).landmarks(rows[own]) + self._widening(c)[:3, :3]
        points = state.points[rows]
        covariances += point_covariances_of_calibration(points, self.calibration)
        main = state.component(0) if graph.records else 0
        return MapLandmarks(ids, points, covariances, _descriptors(graph, rows), counts, component == main)

    def _widening(self, component: int) -> FloatArray:
        """Covariance (6, 6) that is added in a component whose frame nothing ties to the map's."""
        if component == self._state.component(0):
            return np.asarray(ORIGIN_SIGMA**2 * np.eye(6))
        return np.diag(np.square([*[self.unlinked_sigma] * 3, np.pi, np.pi, np.pi]))


def is_antenna(graph: MapGraph) -> BoolArray:
    """Mask (observations,) of those of an antenna's places, which are no landmarks of the building."""
    every = [r.submap.landmark_ids for r in graph.records]
    return is_position_id(np.concatenate([np.empty(0, np.int64), *every]))


def _estimated(graph: MapGraph) -> IntArray:
    """For every landmark, at its name, the observation whose point is the best known."""
    rows = np.arange(len(graph.record_of))
    connecting = np.nonzero(graph.is_connecting)[0]
    rows[graph.landmark_of[connecting]] = graph.variable_of[connecting]
    return rows


def _descriptors(graph: MapGraph, rows: IntArray) -> Float32Array:
    """Descriptors (n, d) of some observations."""
    if not graph.records:
        return np.empty((0, 0), np.float32)
    out = np.empty((len(rows), graph.records[0].submap.descriptors.shape[1]), np.float32)
    record = graph.record_of[rows]
    for i in np.unique(record).tolist():
        own, r = record == i, graph.records[i]
        out[own] = r.submap.descriptors[rows[own] - r.first_observation]
    return out


def _unique_stamps(poses: list[PoseEstimate]) -> list[PoseEstimate]:
    """Sorted by stamp; where a submap ends and the next begins, the pose is given once."""
    return [poses[i] for i in np.unique(np.array([p.stamp_ns for p in poses]), return_index=True)[1]]


def _on_skeleton(
    nodes: FloatArray, records: Sequence[Record], of: IntArray, inside: FloatArray, gains: FloatArray
) -> FloatArray:
    """Poses inside submaps, on the joined skeleton, (n, 4, 4); ``of`` which of the records each is in."""
    T_start, T_end = (nodes[[getattr(r, end) for r in records]] for end in ("start", "end"))
    end_poses = np.array([r.submap.end_pose for r in records])
    correction = boxminus(np.linalg.inv(T_start) @ T_end, end_poses)
    T = boxplus(inside, (gains @ correction[of][..., None])[..., 0])
    return np.asarray(T_start[of] @ T)


def _with_covariances(
    nodes: FloatArray, record: Record, marginals: ComponentMarginals, i: int, gains: FloatArray, remaining: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The poses inside record ``i`` with their covariances (n, 6, 6)."""
    joint, T_start, T_end = marginals.ends(i), nodes[record.start], nodes[record.end]
    inside, T_inverse = np.array([p.T for p in record.submap.path]), invert_transform(T_start)
    poses = _on_skeleton(nodes, [record], np.zeros(len(inside), dtype=np.int64), inside, gains)
    J_inverse, J_end = compose_jacobians(T_inverse, T_end)
    D = np.concatenate([J_inverse @ inverse_jacobian(T_start), J_end], axis=1)
    J_start, J_pose = compose_jacobians(np.broadcast_to(T_start, poses.shape), T_inverse @ poses)
    J = J_pose @ gains @ D
    J[:, :, :6] += J_start
    left = marginals.factor * J_pose @ remaining @ transposed(J_pose)
    # The map's first pose has no covariance of its own.
    return poses, positive(J @ joint @ transposed(J) + left)


def _moving(path: Sequence[PoseEstimate]) -> list[PoseEstimate]:
    """The poses of a path without those that lie within ``STILL`` of the last one kept; the end stays."""
    moved = boxminus(np.array([p.T for p in path]), np.eye(4)) / np.repeat(STILL, 3)
    kept, last = [], np.full(6, np.inf)
    for pose, here in zip(path[:-1], moved, strict=False):
        if np.abs(here - last).max() > 1.0:
            kept.append(pose)
            last = here
    return [*kept, path[-1]]
