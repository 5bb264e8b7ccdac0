"""Joining a submap without a closure at a cost that does not depend on the size of the map.

Everything that was joined before acts on a new submap through its *front* only: the newest pose and the landmarks of
the last few submaps. The front's information matrix comes from the end of the sparse factor, in which these
variables are eliminated last. A new submap is added to it, solved, and what leaves the window is eliminated: the same
elimination that a batch factorisation of all submaps would do, one step further (Kaess, Ranganathan and Dellaert
2008). Older variables learn what changed at the next batch, which a closure or a question for the whole map brings
about.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sjsam_node import kernels
from sjsam_node.estimator import Assembled, reduce_map
from sjsam_node.map_graph import MapGraph, Record
from sjsam_node.problem import LocalMap, flatten
from slam_core.geometry import FloatArray, boxminus, boxplus
from slam_core.linear_algebra.sparse_cholesky import IntArray

_ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class Front:
    """Information (n, n) and gradient (n,) about the newest node and landmarks (k,), at the estimate (T, points)."""

    node: int
    landmarks: IntArray
    T: FloatArray
    points: FloatArray
    information: FloatArray
    gradient: FloatArray

    @classmethod
    def of(cls, graph: MapGraph, assembled: Assembled, node: int, landmarks: IntArray) -> Front:
        """The front of a component that was just optimised with these variables kept for the end."""
        problem = assembled.problem
        scalars = problem.scalars(
            np.searchsorted(assembled.nodes, [node]), np.searchsorted(assembled.landmarks, landmarks)
        )
        information = problem.marginal_information(assembled.state, scalars)
        return cls(node, landmarks, graph.poses[node], graph.points[landmarks], information, np.zeros(len(scalars)))

    def fused(self, landmark_of: IntArray) -> tuple[Front, float]:
        """The front after some of its landmarks turned out to be the same; and the rise of chi2 that this costs.

        Of such landmarks the oldest stays; the others are where it is: ``x_gone = x_kept``.
        """
        now = landmark_of[self.landmarks]
        if np.array_equal(now, self.landmarks):
            return self, 0.0
        kept = np.nonzero(now == self.landmarks)[0]
        home = kept[np.searchsorted(self.landmarks[kept], now)]
        shift = np.concatenate([np.zeros(6), (self.points[home] - self.points).ravel()])
        M = np.zeros((len(shift), 6 + 3 * len(kept)))
        M[np.arange(6), np.arange(6)] = 1.0
        column = np.searchsorted(kept, home)
        for axis in range(3):
            M[6 + 3 * np.arange(len(home)) + axis, 6 + 3 * column + axis] = 1.0
        pull = self.information @ shift
        front = Front(
            self.node, self.landmarks[kept], self.T, self.points[kept],
            M.T @ self.information @ M, M.T @ (self.gradient + pull),
        )  # fmt: skip
        return front, float(shift @ (2.0 * self.gradient + pull))

    def extended(self, graph: MapGraph, record: Record, kept: IntArray, rows: str) -> tuple[Front, float, float]:
        """The front after one more submap that starts at its node, of the landmarks ``kept``; the rise of chi2; and by
        how much (rad) the node turned against where everything older was linearised.

        The graph's estimate of the front and of the new submap is updated.
        """
        step = _Step(self, graph, record, rows)
        cost = step.solve()
        step.write(graph, record)
        turn = float(np.linalg.norm(boxminus(step.poses[0], self.T)[3:]))
        return step.reduced(graph, record, kept), cost, turn


class _Step:
    """Front and new submap as one small dense problem: variables are (old node, new node, landmarks)."""

    def __init__(self, front: Front, graph: MapGraph, record: Record, rows: str) -> None:
        seen = graph.landmark_of[record.observations]
        self.front = front
        self.landmarks = np.concatenate([front.landmarks, seen[~np.isin(seen, front.landmarks)]])
        everything = reduce_map(record, np.ones(len(seen), dtype=bool), rows)
        order = np.argsort(self.landmarks)
        index = order[np.searchsorted(self.landmarks, seen, sorter=order)]
        local = LocalMap(0, np.array([1]), index, everything.mean, everything.information)
        self.maps = flatten([local])
        self.work = kernels.work_space(self.maps)
        self.poses = [graph.poses[record.start].copy(), graph.poses[record.end].copy()]
        self.points = graph.points[self.landmarks].copy()
        landmark_rows = (12 + 3 * index[:, None] + np.arange(3)).ravel()
        self.own_rows = np.concatenate([np.arange(12), landmark_rows])
        k = len(front.landmarks)
        self.front_rows = np.concatenate([np.arange(6), 12 + np.arange(3 * k)])
        self.H, self.g = np.empty((0, 0)), np.empty(0)

    def solve(self) -> float:
        """Gauss-Newton to the optimum; the cost there."""
        for _ in range(_ITERATIONS):
            self._linearize()
            step = cho_solve(cho_factor(self.H), -self.g)
            self.poses = [boxplus(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(self.poses)]
            self.points = self.points + step[12:].reshape(-1, 3)
            if -self.g @ step < 1e-8:
                break
        cost = self._linearize()
        return cost

    def _linearize(self) -> float:
        n = 12 + 3 * len(self.landmarks)
        self.H, self.g = np.zeros((n, n)), np.zeros(n)
        k = len(self.front.landmarks)
        moved = np.concatenate([boxminus(self.poses[0], self.front.T), (self.points[:k] - self.front.points).ravel()])
        pull = self.front.information @ moved
        self.H[np.ix_(self.front_rows, self.front_rows)] = self.front.information
        self.g[self.front_rows] = self.front.gradient + pull
        poses = np.array(self.poses)
        R, t = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        H, g = kernels.local_normal_equations(kernels.TANGENT, 0, self.maps, R, t, self.points, self.work)
        self.H[np.ix_(self.own_rows, self.own_rows)] += H
        self.g[self.own_rows] += g
        own = kernels.joint_cost(kernels.TANGENT, self.maps, R, t, self.points)
        return float(own + moved @ (2.0 * self.front.gradient + pull))

    def write(self, graph: MapGraph, record: Record) -> None:
        graph.poses[record.start], graph.poses[record.end] = self.poses
        graph.points[self.landmarks] = self.points

    def reduced(self, graph: MapGraph, record: Record, kept: IntArray) -> Front:
        """Eliminate the old node and the landmarks that are not ``kept``."""
        stays = np.isin(self.landmarks, kept)
        mask = np.concatenate([np.zeros(6, bool), np.ones(6, bool), np.repeat(stays, 3)])
        s, e = np.nonzero(mask)[0], np.nonzero(~mask)[0]
        gain = cho_solve(cho_factor(self.H[np.ix_(e, e)]), self.H[np.ix_(e, s)]).T
        information = self.H[np.ix_(s, s)] - gain @ self.H[np.ix_(e, s)]
        gradient = self.g[s] - gain @ self.g[e]
        return Front(
            record.end, self.landmarks[stays], self.poses[1], self.points[stays],
            0.5 * (information + information.T), gradient,
        )  # fmt: skip
