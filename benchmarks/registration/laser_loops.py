# SPDX-License-Identifier: Apache-2.0
"""Loops in the plane: a trajectory cut into nodes, places seen again found by registration, the graph of all optimised.

A node's cloud is merged from the scans of half a metre around it, a candidate's from some metres, so that one who comes
back facing the other way still sees much of it. The candidate is searched as far as the trajectory may have drifted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from laser_log import LaserScan, pose2
from planar_graph import PlanarGraph, composed, relative

from ndt_registration.registration import RegistrationConfig, Target, register
from slam_core.geometry import FloatArray, invert_transform

NODE_DISTANCE, NODE_ANGLE = 0.5, np.deg2rad(15.0)
LEAST_AGE = 12.0
"""Way (m) after which a place counts as seen again."""
REACH, DRIFT, MOST_REACH = 2.0, 0.03, 4.0
"""How far off (m) a place may be: at once, per metre of way, and at most."""
LEAST_OVERLAP = 0.5
SEARCH_STEP = 0.5
SOURCE_NODES, TARGET_NODES, CANDIDATES, APART = 2, 8, 2, 6
"""Nodes merged to either side; candidates per node, and how many nodes they lie apart."""
MERGED_SCANS, VIEW = {SOURCE_NODES: 8, TARGET_NODES: 24}, 20.0
ODOMETRY_SIGMA = np.array([0.01, 0.01, 0.004])
ODOMETRY_SHARE = np.array([0.03, 0.03, 0.03])
"""Noise of the motion between nodes: m, m, rad, and its growth with distance and angle."""
LOOP_SIGMA = np.array([0.03, 0.03, 0.005])
"""Added to a loop's own covariance: what the merged clouds are warped by."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Nodes and pose of ``later`` in ``earlier`` (x, y, yaw)."""

    earlier: int
    later: int
    pose: FloatArray


class LoopCloser:
    """Closes the loops of a trajectory of poses (4, 4), one per scan."""

    def __init__(self, scans: list[LaserScan], poses: list[FloatArray]) -> None:
        self._scans, self._poses = scans, poses
        self.nodes = _nodes(poses)
        self.loops: list[Loop] = []
        self._graph = PlanarGraph([planar(poses[0])])
        self._way = [0.0]
        self._config = RegistrationConfig()
        self._targets: dict[int, Target] = {}

    def run(self) -> list[FloatArray]:
        """The optimised poses of all scans; node by node, as they come."""
        for node in range(1, len(self.nodes)):
            self._append(node)
            found = [loop for c in self._candidates(node) if (loop := self._closed(c, node)) is not None]
            self.loops += found
            if found:
                self._graph.optimise(5)
        self._graph.optimise(30)
        of = np.searchsorted(self.nodes, np.arange(len(self._poses)), side="right") - 1
        return [
            pose2(*self._graph.poses[n]) @ invert_transform(self._poses[self.nodes[n]]) @ T
            for n, T in zip(of, self._poses, strict=True)
        ]

    def _append(self, node: int) -> None:
        step = planar(invert_transform(self._poses[self.nodes[node - 1]]) @ self._poses[self.nodes[node]])
        distance, angle = np.hypot(step[0], step[1]), abs(step[2])
        sigma = ODOMETRY_SIGMA + ODOMETRY_SHARE * np.array([distance, distance, angle])
        self._graph.poses.append(composed(self._graph.poses[-1], step))
        self._graph.add_edge(node - 1, node, step, np.diag(sigma**2), loop=False)
        self._way.append(self._way[-1] + distance)

    def _reach(self, node: int) -> FloatArray:
        """How far each earlier node may be from where the graph has it, m."""
        age = self._way[node] - np.array(self._way[:node])
        return np.where(age > LEAST_AGE, np.minimum(REACH + DRIFT * age, MOST_REACH), 0.0)

    def _candidates(self, node: int) -> list[int]:
        """The nearest places that may be this one."""
        poses = np.array(self._graph.poses)
        distance = np.linalg.norm(poses[:-1, :2] - poses[-1, :2], axis=1)
        chosen: list[int] = []
        for k in np.argsort(distance):
            if distance[k] < self._reach(node)[k] and all(abs(k - other) > APART for other in chosen):
                chosen.append(int(k))
        return chosen[:CANDIDATES]

    def _closed(self, earlier: int, later: int) -> Loop | None:
        """The loop between two nodes, added to the graph, if one is found."""
        if earlier not in self._targets:
            self._targets[earlier] = Target.build(self._merged(earlier, TARGET_NODES), self._config)
        target = self._targets[earlier]
        guess = pose2(*relative(self._graph.poses[earlier], self._graph.poses[later]))
        points = self._merged(later, SOURCE_NODES) @ guess[:2, :2].T + guess[:2, 3]
        scale = target.cloud.scale
        search = replace(
            self._config.search,
            max_translation=float(self._reach(later)[earlier] / scale),
            translation_step=SEARCH_STEP / scale,
            max_rotation_deg=18.0,
            rotation_step_deg=9.0,
        )
        result = register(points, target, None, replace(self._config, search=search))
        if not result.converged and result.degenerate:
            # A search stands by no pose that may slide, but along a corridor the other directions still tie the graph.
            result = register(points, target, result.T_target_source, self._config)
        if not result.converged or result.overlap < LEAST_OVERLAP:
            return None
        loop = Loop(earlier, later, planar(result.T_target_source @ guess))
        covariance = result.covariance[np.ix_([0, 1, 5], [0, 1, 5])] + np.diag(LOOP_SIGMA**2)
        self._graph.add_edge(earlier, later, loop.pose, covariance, loop=True)
        return loop

    def _merged(self, node: int, half: int) -> FloatArray:
        """Points (n, 2) of scans around a node, in its frame."""
        first, last = self.nodes[max(node - half, 0)], self.nodes[min(node + half, len(self.nodes) - 1)]
        origin = invert_transform(self._poses[self.nodes[node]])
        clouds = []
        for k in np.unique(np.linspace(first, last, MERGED_SCANS[half]).astype(int)):
            T = origin @ self._poses[k]
            clouds.append(self._scans[k].points @ T[:2, :2].T + T[:2, 3])
        points = np.concatenate(clouds)
        return np.asarray(points[np.linalg.norm(points, axis=1) < VIEW])


def planar(T: FloatArray) -> FloatArray:
    """x, y, yaw of a pose (4, 4)."""
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


def _nodes(poses: list[FloatArray]) -> list[int]:
    nodes = [0]
    for k, T in enumerate(poses):
        step = planar(invert_transform(poses[nodes[-1]]) @ T)
        if np.hypot(step[0], step[1]) > NODE_DISTANCE or abs(step[2]) > NODE_ANGLE:
            nodes.append(k)
    return nodes
