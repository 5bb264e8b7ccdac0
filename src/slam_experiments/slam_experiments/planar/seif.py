# SPDX-License-Identifier: Apache-2.0
"""Sparse extended information filter in the plane (Thrun et al. 2004, thesis 6.4.1).

What is known is kept as an information matrix. The pose is linked to a few *active* landmarks only: whenever there are
more, some are made passive, and what their links said is spread over the others. So a step touches a bounded number of
entries, whatever the size of the map. The price: dropping links claims an independence that is not there, and the mean
is only improved landmark by landmark.

Everything is kept around the mean: with the error e of the state, ``p(e) ~ exp(-e' H e / 2 + r' e)``; where the mean
has been found, r is zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ekf_slam_node.association.jcbb import IndexArray
from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import POSE_DIM, PlanarConfig, move, place, range_bearing, wrap

ACTIVE = 10
"""Landmarks that the pose is linked to at most."""
_RELAXED = 20
"""Passive landmarks whose mean is improved in a step."""
_NEGLIGIBLE = 1e-6
"""Step of a landmark's mean, over its own standard deviation, that is not worth telling its neighbours."""


class PlanarSeif:
    """SEIF-SLAM with known association.

    Parameters
    ----------
    pose, pose_covariance
        Where the robot starts, (3,) m and rad, and how well that is known (3, 3).
    """

    def __init__(self, config: PlanarConfig, pose: FloatArray, pose_covariance: FloatArray) -> None:
        self.pose = np.array(pose, dtype=np.float64)
        self.ids: dict[int, int] = {}
        self._points: list[FloatArray] = []
        self._information = np.linalg.inv(np.diag([config.sigma_range**2, config.sigma_bearing**2]))
        self._H_pose = np.linalg.inv(pose_covariance)
        self._r_pose = np.zeros(POSE_DIM)
        self._to_pose: dict[int, FloatArray] = {}  # active landmark: (3, 2)
        self._links: list[dict[int, FloatArray]] = []  # of each landmark, to itself and others: (2, 2)
        self._r: list[FloatArray] = []
        self._waiting: dict[int, None] = {}  # landmarks whose mean is to be improved, in order

    @property
    def landmarks(self) -> FloatArray:
        """Means (m, 2) of the landmarks, in the order in which they were first seen."""
        return np.reshape(self._points, (-1, 2))

    @property
    def numbers(self) -> int:
        """Numbers that are stored."""
        return 9 + 6 * len(self._to_pose) + sum(4 * len(links) for links in self._links) + 4 * len(self._links)

    def predict(self, motion: FloatArray, motion_covariance: FloatArray) -> None:
        """Move by (3,) in the robot's frame, with covariance (3, 3)."""
        self.pose, F, G = move(self.pose, motion)
        back = np.linalg.inv(F)
        active = list(self._to_pose)
        H, r = self._local(active)
        H[:POSE_DIM] = back.T @ H[:POSE_DIM]
        H[:, :POSE_DIM] = H[:, :POSE_DIM] @ back
        r[:POSE_DIM] = back.T @ r[:POSE_DIM]
        noise = np.linalg.inv(G @ motion_covariance @ G.T)
        gain = np.linalg.solve(noise + H[:POSE_DIM, :POSE_DIM], np.column_stack([H[:POSE_DIM], r[:POSE_DIM]]))
        r -= H[:, :POSE_DIM] @ gain[:, -1]
        self._store(active, H - H[:, :POSE_DIM] @ gain[:, :-1], r)

    def process(self, measured: FloatArray, ids: IndexArray) -> None:
        """Update with measurements (k, 2) of the landmarks ``ids`` (k,), new ones included."""
        slots = [self._slot(int(i), z) for i, z in zip(ids, measured, strict=True)]
        if slots:
            self._measure(measured, slots)
            self._relax(slots)
        self._make_passive(set(slots))
        self._relax_waiting()

    def _slot(self, landmark_id: int, z: FloatArray) -> int:
        if landmark_id not in self.ids:
            self.ids[landmark_id] = len(self._points)
            self._points.append(place(self.pose, z)[0])
            self._links.append({len(self._links): np.zeros((2, 2))})
            self._r.append(np.zeros(2))
        return self.ids[landmark_id]

    def _measure(self, measured: FloatArray, slots: Sequence[int]) -> None:
        z, J_pose, J_landmark = range_bearing(self.pose, np.array([self._points[s] for s in slots]))
        innovation = measured - z
        innovation[:, 1] = wrap(innovation[:, 1])
        for k, slot in enumerate(slots):
            weighted_pose, weighted_point = J_pose[k].T @ self._information, J_landmark[k].T @ self._information
            self._H_pose = self._H_pose + weighted_pose @ J_pose[k]
            self._r_pose = self._r_pose + weighted_pose @ innovation[k]
            self._to_pose[slot] = self._to_pose.get(slot, 0.0) + weighted_pose @ J_landmark[k]
            self._links[slot][slot] = self._links[slot][slot] + weighted_point @ J_landmark[k]
            self._r[slot] = self._r[slot] + weighted_point @ innovation[k]

    def _make_passive(self, seen: set[int]) -> None:
        """Cut the pose's links to the landmarks beyond ``ACTIVE``, those not seen now and the farthest first.

        Of the pose and its landmarks, the density is replaced by that of the pose given those that stay, times that of
        all landmarks (table 12.5 of Probabilistic Robotics).
        """
        active = sorted(
            self._to_pose, key=lambda s: (s not in seen, float(np.linalg.norm(self._points[s] - self.pose[:2])), s)
        )
        if len(active) <= ACTIVE:
            return
        H, r = self._local(active)
        pose = np.arange(POSE_DIM)
        cut = np.arange(POSE_DIM + 2 * ACTIVE, len(H))
        H = H - _share(H, cut) + _share(H, np.r_[pose, cut]) - _share(H, pose)
        self._to_pose = {slot: self._to_pose[slot] for slot in active[:ACTIVE]}
        H[np.ix_(pose, cut)] = 0.0
        self._store(active, H, r)

    def _local(self, active: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Information of the pose and some landmarks, the others held fixed, and r; both as one matrix and vector."""
        n = POSE_DIM + 2 * len(active)
        H, r = np.zeros((n, n)), np.empty(n)
        H[:POSE_DIM, :POSE_DIM], r[:POSE_DIM] = self._H_pose, self._r_pose
        for k, slot in enumerate(active):
            rows = slice(POSE_DIM + 2 * k, POSE_DIM + 2 * k + 2)
            r[rows] = self._r[slot]
            if slot in self._to_pose:
                H[:POSE_DIM, rows] = self._to_pose[slot]
                H[rows, :POSE_DIM] = self._to_pose[slot].T
            for j, other in enumerate(active):
                link = self._links[slot].get(other)
                if link is not None:
                    H[rows, POSE_DIM + 2 * j : POSE_DIM + 2 * j + 2] = link
        return H, r

    def _store(self, active: Sequence[int], H: FloatArray, r: FloatArray) -> None:
        self._H_pose, self._r_pose = 0.5 * (H[:POSE_DIM, :POSE_DIM] + H[:POSE_DIM, :POSE_DIM].T), r[:POSE_DIM].copy()
        for k, slot in enumerate(active):
            rows = slice(POSE_DIM + 2 * k, POSE_DIM + 2 * k + 2)
            self._r[slot] = r[rows].copy()
            if slot in self._to_pose:
                self._to_pose[slot] = H[:POSE_DIM, rows].copy()
            for j, other in enumerate(active):
                columns = slice(POSE_DIM + 2 * j, POSE_DIM + 2 * j + 2)
                self._links[slot][other] = 0.5 * (H[rows, columns] + H[columns, rows].T)

    def _relax(self, slots: Sequence[int]) -> None:
        """Bring the pose and some landmarks to their mean, given all others."""
        H, r = self._local(slots)
        step = np.asarray(np.linalg.solve(H, r), np.float64)
        self.pose = self.pose + step[:POSE_DIM]
        self.pose[2] = wrap(self.pose[2])
        self._r_pose = self._r_pose - H[:POSE_DIM] @ step
        for slot in self._to_pose.keys() - set(slots):
            self._r[slot] = self._r[slot] - self._to_pose[slot].T @ step[:POSE_DIM]
            self._waiting.setdefault(slot)
        for slot in slots:  # the links to the pose of those that move
            self._r[slot] = self._r[slot] - self._to_pose[slot].T @ step[:POSE_DIM]
        for k, slot in enumerate(slots):
            self._move_landmark(slot, step[POSE_DIM + 2 * k : POSE_DIM + 2 * k + 2])

    def _relax_waiting(self) -> None:
        """Bring a few more landmarks, those whose neighbours have moved longest ago, to their mean one by one."""
        for _ in range(min(_RELAXED, len(self._waiting))):
            slot = next(iter(self._waiting))
            del self._waiting[slot]
            own = self._links[slot][slot]
            step = np.asarray(np.linalg.solve(own, self._r[slot]), np.float64)
            if step @ own @ step > _NEGLIGIBLE**2:
                if slot in self._to_pose:
                    self._r_pose = self._r_pose - self._to_pose[slot] @ step
                self._move_landmark(slot, step)

    def _move_landmark(self, slot: int, step: FloatArray) -> None:
        self._points[slot] = self._points[slot] + step
        for other, link in self._links[slot].items():
            self._r[other] = self._r[other] - link.T @ step
            if other != slot:
                self._waiting.setdefault(other)


def _share(H: FloatArray, rows: IndexArray) -> FloatArray:
    """Part of an information matrix that is lost when ``rows`` are marginalised out."""
    return np.asarray(H[:, rows] @ np.linalg.solve(H[np.ix_(rows, rows)], H[rows]))
