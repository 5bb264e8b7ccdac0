# SPDX-License-Identifier: Apache-2.0
"""Conditionally independent submaps in the plane (Pinies and Tardos 2008, thesis 6.3.1).

Each submap is an EKF of a bounded number of landmarks, all in one frame. The next one begins with what it needs of the
last: the pose and the landmarks in view, with their covariance. Given these, old and new know nothing of each other, so
that what the new one learns about them can be carried back exactly, whenever it is asked for, in time linear in the
number of submaps. A landmark of an older submap that is seen again is first carried forward through all in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ekf_slam_node.association.jcbb import IndexArray
from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import POSE_DIM, PlanarConfig, move, place, range_bearing, wrap

LARGEST = 40
"""Landmarks after which a submap ends."""
_FIRST_LANDMARK = 2 * POSE_DIM


@dataclass(eq=False)
class IndependentSubmap:
    """A Gaussian of the pose now, the pose at the submap's start, and landmarks.

    mean: (n,); covariance: (n, n).
    """

    mean: FloatArray
    covariance: FloatArray
    rows: dict[int, int] = field(default_factory=dict)
    """Landmark's id to its first row."""

    def points(self, ids: list[int]) -> IndexArray:
        """Rows (2k,) of landmarks."""
        first = np.array([self.rows[i] for i in ids], dtype=np.int64)
        return (first[:, None] + np.arange(2)).ravel()

    def append(self, landmark_id: int, point: FloatArray, cross: FloatArray, own: FloatArray) -> None:
        """Add a landmark with its covariance with all there is, (2, n), and its own (2, 2)."""
        self.rows[landmark_id] = len(self.mean)
        self.mean = np.concatenate([self.mean, point])
        self.covariance = np.block([[self.covariance, cross.T], [cross, own]])


class IndependentSubmaps:
    """EKF-SLAM in conditionally independent submaps, with known association.

    Parameters
    ----------
    pose, pose_covariance
        Where the robot starts, (3,) m and rad, and how well that is known (3, 3).
    """

    def __init__(self, config: PlanarConfig, pose: FloatArray, pose_covariance: FloatArray) -> None:
        self.maps = [IndependentSubmap(np.tile(pose, 2).astype(np.float64), np.tile(pose_covariance, (2, 2)))]
        self._noise = np.diag([config.sigma_range**2, config.sigma_bearing**2])
        self._home: dict[int, int] = {}  # landmark's id to the newest submap that has it

    @property
    def pose(self) -> FloatArray:
        """The newest pose (3,)."""
        return self.maps[-1].mean[:POSE_DIM]

    @property
    def numbers(self) -> int:
        """Numbers that are stored."""
        return sum(m.covariance.size + m.mean.size for m in self.maps)

    def predict(self, motion: FloatArray, motion_covariance: FloatArray) -> None:
        """Move by (3,) in the robot's frame, with covariance (3, 3)."""
        m = self.maps[-1]
        m.mean[:POSE_DIM], F, G = move(self.pose, motion)
        head = F @ m.covariance[:POSE_DIM]
        m.covariance[:POSE_DIM], m.covariance[:, :POSE_DIM] = head, head.T
        m.covariance[:POSE_DIM, :POSE_DIM] = head[:, :POSE_DIM] @ F.T + G @ motion_covariance @ G.T

    def process(self, measured: FloatArray, ids: IndexArray) -> None:
        """Update with measurements (k, 2) of the landmarks ``ids`` (k,), new ones included.

        Then the next submap begins if this one is full.
        """
        known = [int(i) in self._home for i in ids]
        older = [i for i in ids[known].tolist() if i not in self.maps[-1].rows]
        if older:
            self._carry_back(min(self._home[i] for i in older))
        for landmark_id in older:
            self._fetch(landmark_id)
        if any(known):
            self._update(measured[known], ids[known].tolist())
        for z, landmark_id in zip(measured, ids.tolist(), strict=True):
            if landmark_id not in self._home:
                self._augment(z, landmark_id)
        if len(self.maps[-1].rows) > LARGEST:
            self._begin(ids.tolist())

    def landmarks(self) -> tuple[IndexArray, FloatArray, FloatArray]:
        """Ids (m,), means (m, 2) and covariances (m, 2, 2) of all, everything learnt since carried back."""
        self._carry_back(0)
        ids = np.array(sorted(self._home), dtype=np.int64)
        found = [(m, m.points([i])) for i, m in ((i, self.maps[self._home[i]]) for i in ids.tolist())]
        return ids, np.array([m.mean[r] for m, r in found]), np.array([m.covariance[np.ix_(r, r)] for m, r in found])

    def _update(self, measured: FloatArray, ids: list[int]) -> None:
        m = self.maps[-1]
        rows = m.points(ids)
        z, J_pose, J_landmark = range_bearing(self.pose, m.mean[rows].reshape(-1, 2))
        innovation = measured - z
        innovation[:, 1] = wrap(innovation[:, 1])
        k = len(ids)
        H = np.zeros((k, 2, len(m.mean)))
        H[:, :, :POSE_DIM] = J_pose
        H[np.arange(k)[:, None, None], np.arange(2)[:, None], rows.reshape(k, 1, 2)] = J_landmark
        J = H.reshape(2 * k, -1)
        cross = m.covariance @ J.T
        S = J @ cross + np.kron(np.eye(k), self._noise)
        gain = np.linalg.solve(S, cross.T).T
        m.mean += gain @ innovation.ravel()
        m.mean[[2, POSE_DIM + 2]] = wrap(m.mean[[2, POSE_DIM + 2]])
        m.covariance = _symmetric(m.covariance - gain @ cross.T)

    def _augment(self, z: FloatArray, landmark_id: int) -> None:
        m = self.maps[-1]
        point, J_pose, J_z = place(self.pose, z)
        cross = J_pose @ m.covariance[:POSE_DIM]
        m.append(landmark_id, point, cross, cross[:, :POSE_DIM] @ J_pose.T + J_z @ self._noise @ J_z.T)
        self._home[landmark_id] = len(self.maps) - 1

    def _begin(self, in_view: list[int]) -> None:
        """Start a submap at the pose, with the landmarks in view."""
        m = self.maps[-1]
        taken = np.concatenate([np.tile(np.arange(POSE_DIM), 2), m.points(in_view)])
        rows = {landmark_id: _FIRST_LANDMARK + 2 * k for k, landmark_id in enumerate(in_view)}
        self.maps.append(IndependentSubmap(m.mean[taken], m.covariance[np.ix_(taken, taken)], rows))
        self._home |= dict.fromkeys(in_view, len(self.maps) - 1)

    def _common(self, k: int) -> tuple[IndexArray, IndexArray]:
        """Rows of submaps k and k + 1 that are the same: the pose at which they meet, and landmarks of both."""
        first, second = self.maps[k], self.maps[k + 1]
        ids = [i for i in first.rows if i in second.rows]
        pose = np.arange(POSE_DIM)
        return np.concatenate([pose, first.points(ids)]), np.concatenate([POSE_DIM + pose, second.points(ids)])

    def _carry_back(self, down_to: int) -> None:
        """Tell the submaps from ``down_to`` on what was learnt after them about what they share with the next."""
        for k in range(len(self.maps) - 2, down_to - 1, -1):
            m, later = self.maps[k], self.maps[k + 1]
            own, other = self._common(k)
            gain = np.linalg.solve(m.covariance[np.ix_(own, own)], m.covariance[own]).T
            learnt = later.mean[other] - m.mean[own]
            learnt[2] = wrap(learnt[2])
            m.mean = m.mean + gain @ learnt
            m.mean[[2, POSE_DIM + 2]] = wrap(m.mean[[2, POSE_DIM + 2]])
            change = later.covariance[np.ix_(other, other)] - m.covariance[np.ix_(own, own)]
            m.covariance = _symmetric(m.covariance + gain @ change @ gain.T)

    def _fetch(self, landmark_id: int) -> None:
        """Bring a landmark of an older submap into every one from there to the newest.

        All of them agree on what they share, so that it stays where it is.
        """
        for k in range(self._home[landmark_id], len(self.maps) - 1):
            m, later = self.maps[k], self.maps[k + 1]
            own, other = self._common(k)
            rows = m.points([landmark_id])
            gain = np.linalg.solve(m.covariance[np.ix_(own, own)], m.covariance[np.ix_(own, rows)]).T
            cross = gain @ later.covariance[other]
            later.append(landmark_id, m.mean[rows].copy(), cross, m.covariance[np.ix_(rows, rows)])
            self._home[landmark_id] = k + 1


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))
