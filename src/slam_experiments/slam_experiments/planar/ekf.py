# SPDX-License-Identifier: Apache-2.0
"""The 2D twin (thesis 1.7, 5.1): EKF-SLAM of a wheeled robot that measures ranges and bearings of landmarks.

State: x, y, heading, then two coordinates per landmark. It shares the covariance, the Cholesky update, the invariant
error and JCBB with the 3D filter; only the models differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ekf_slam_node.association.ccda import ccda, distance_variances, equal_distances
from ekf_slam_node.association.jcbb import UNPAIRED, IndexArray, JointPrediction, jcbb
from ekf_slam_node.filtering.covariance import Covariance, whiten
from ekf_slam_node.filtering.ekf import UpdateReport
from slam_core.config import Config, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray

POSE_DIM = 3
_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class PlanarConfig(Config):
    """Noise and association of the planar filter."""

    sigma_range: float = parameter(0.05, "noise of a range", unit="m", minimum=1e-6)
    sigma_bearing: float = parameter(0.02, "noise of a bearing", unit="rad", minimum=1e-6)
    error: str = parameter("invariant", "error state", choices=("invariant", "standard"))
    method: str = parameter(
        "jcbb", "association where it is not known", choices=("nearest", "mahalanobis", "jcbb", "ccda")
    )
    confidence: float = parameter(0.99, "of the compatibility tests", minimum=0.5, maximum=0.999999)
    nearest_associate: float = parameter(0.5, "g_A of Algorithm 1", unit="m", minimum=0.0)
    new_confidence: float = parameter(
        0.9999, "a measurement this far from every landmark is a new one (g_R)", minimum=0.5, maximum=0.99999999
    )


def wrap(angle: npt.ArrayLike) -> FloatArray:
    """Angles (rad) in [-pi, pi)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi)


def turn(heading: float) -> FloatArray:
    """Rotation (2, 2) of a heading (rad)."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])


def move(pose: FloatArray, motion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pose (3,) after a motion (3,) in its own frame, and its Jacobians (3, 3) with respect to pose and motion."""
    R = turn(pose[2])
    after = np.array([*(pose[:2] + R @ motion[:2]), wrap(pose[2] + motion[2])])
    J_pose, J_motion = np.eye(3), np.eye(3)
    J_pose[:2, 2] = _QUARTER_TURN @ R @ motion[:2]
    J_motion[:2, :2] = R
    return after, J_pose, J_motion


def range_bearing(pose: FloatArray, landmarks: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ranges and bearings (n, 2) of landmarks (n, 2), with Jacobians.

    The Jacobians are with respect to pose (n, 2, 3) and landmark (n, 2, 2).
    """
    delta = landmarks - pose[:2]
    squared = np.einsum("ni,ni->n", delta, delta)
    distance = np.sqrt(squared)
    z = np.column_stack([distance, wrap(np.arctan2(delta[:, 1], delta[:, 0]) - pose[2])])
    J = np.empty((len(delta), 2, 2))
    J[:, 0] = delta / distance[:, None]
    J[:, 1] = delta @ _QUARTER_TURN.T / squared[:, None]
    J_pose = np.concatenate([-J, np.broadcast_to([[0.0], [-1.0]], (len(delta), 2, 1))], axis=2)
    return z, J_pose, J


def place(pose: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Landmark (2,) of one measurement (2,), with Jacobians with respect to pose (2, 3) and measurement (2, 2)."""
    direction = turn(pose[2]) @ [np.cos(z[1]), np.sin(z[1])]
    sideways = _QUARTER_TURN @ direction
    J_pose = np.column_stack([np.eye(2), z[0] * sideways])
    return pose[:2] + z[0] * direction, J_pose, np.column_stack([direction, z[0] * sideways])


class PlanarEkf:
    """EKF-SLAM in the plane.

    Parameters
    ----------
    pose, pose_covariance
        Where the robot starts, (3,) m and rad, and how well that is known (3, 3).
    """

    def __init__(self, config: PlanarConfig, pose: FloatArray, pose_covariance: FloatArray) -> None:
        self.config = config
        self.pose = np.array(pose, dtype=np.float64)
        self.landmarks = np.zeros((0, 2))
        self.ids: list[int] = []
        self.covariance = Covariance(pose_covariance)
        self._noise = np.diag([config.sigma_range**2, config.sigma_bearing**2])

    def predict(self, motion: FloatArray, motion_covariance: FloatArray) -> None:
        """Move by (3,) in the robot's frame, with covariance (3, 3)."""
        head = self.covariance.head(POSE_DIM)
        self.pose, F, G = move(self.pose, motion)
        head = head @ F.T
        head[:POSE_DIM] = F @ head[:POSE_DIM] + G @ motion_covariance @ G.T
        self.covariance.set_head(head)

    def process(self, measured: FloatArray, ids: IndexArray | None = None) -> tuple[UpdateReport, IndexArray]:
        """Update with measurements (k, 2), new landmarks included; returns the report and the landmark slots used (k,).

        Without ``ids`` (k,) the association is searched; a measurement that is neither one of a landmark nor clearly
        new gets slot -1.
        """
        known = self._known(ids) if ids is not None else self._associate(measured)
        seen = np.flatnonzero(known >= 0)
        report = self.update(measured[seen], known[seen]) if len(seen) else UpdateReport(0.0, 0, False)
        new = np.flatnonzero(known == UNPAIRED) if ids is not None else self._new(measured, known)
        for k in new:
            known[k] = self._augment(measured[k], int(ids[k]) if ids is not None else len(self.landmarks))
        return report, known

    def update(self, measured: FloatArray, slots: IndexArray) -> UpdateReport:
        """Measurements (k, 2) of the landmarks ``slots`` (k,)."""
        z, cross, S = self._predicted(slots)
        innovation = measured - z
        innovation[:, 1] = wrap(innovation[:, 1])
        S = S + np.kron(np.eye(len(slots)), self._noise)
        whitened = whiten(np.asfortranarray(S), cross, innovation.ravel())
        if whitened is None:
            return UpdateReport(np.nan, innovation.size, False)
        W, y = whitened
        self.covariance.subtract_square(W)
        self._move(W @ y)
        return UpdateReport(float(y @ y), len(y), True)

    def innovation_nis(self, measured: FloatArray, slots: IndexArray) -> FloatArray:
        """NIS (k,) of measurements (k, 2) of the landmarks ``slots`` (k,), each on its own; 2 degrees of freedom."""
        z, _, joint = self._predicted(slots)
        k = len(slots)
        S = joint.reshape(k, 2, k, 2)[np.arange(k), :, np.arange(k)] + self._noise
        innovation = measured - z
        innovation[:, 1] = wrap(innovation[:, 1])
        return np.asarray(np.einsum("ki,kij,kj->k", innovation, np.linalg.inv(S), innovation))

    def _predicted(self, slots: IndexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Measurements expected (k, 2), ``P H'`` and ``H P H'``."""
        z, J_pose, J_landmark = range_bearing(self.pose, self.landmarks[slots])
        k = len(slots)
        rows = POSE_DIM + 2 * np.asarray(slots)[:, None] + np.arange(2)
        points = self.covariance.columns(rows.ravel()).reshape(-1, k, 2)
        pose = self.covariance.columns(np.arange(POSE_DIM))
        cross = np.einsum("np,kmp->nkm", pose, J_pose) + np.einsum("nkl,kml->nkm", points, J_landmark)
        S = J_pose @ cross[:POSE_DIM].reshape(POSE_DIM, -1) + J_landmark @ cross[rows].reshape(k, 2, -1)
        S = S.reshape(2 * k, 2 * k)
        return z, np.asfortranarray(cross.reshape(-1, 2 * k)), 0.5 * (S + S.T)

    def _move(self, delta: FloatArray) -> None:
        old = np.vstack([self.pose[:2], self.landmarks])
        new = old + np.vstack([delta[:2], delta[POSE_DIM:].reshape(-1, 2)])
        if self.config.error == "invariant":
            new = _moved(old, new - old, delta[2])
        self.pose = np.array([*new[0], wrap(self.pose[2] + delta[2])])
        self.landmarks = new[1:]
        if self.config.error == "invariant":
            self._change_coordinates(new - old)

    def _change_coordinates(self, moved: FloatArray) -> None:
        """As in the 3D filter: point errors are counted relative to the rotation error at the new estimate."""
        A = np.zeros((self.covariance.size, 1), order="F")
        shift = moved @ _QUARTER_TURN.T
        A[:2, 0], A[POSE_DIM:, 0] = shift[0], shift[1:].ravel()
        B = self.covariance.columns(np.array([2]))
        self.covariance.add_product(A, B + 0.5 * A @ B[2:3])

    def _augment(self, measured: FloatArray, landmark_id: int) -> int:
        point, J_pose, J_z = place(self.pose, measured)
        head = self.covariance.head(POSE_DIM)
        block = J_pose @ head[:POSE_DIM] @ J_pose.T + J_z @ self._noise @ J_z.T
        self.covariance.append(J_pose @ head.T, block)
        self.landmarks = np.vstack([self.landmarks, point])
        self.ids.append(landmark_id)
        return len(self.ids) - 1

    # ---- association
    def _known(self, ids: IndexArray) -> IndexArray:
        slots = {landmark_id: slot for slot, landmark_id in enumerate(self.ids)}
        return np.array([slots.get(int(i), UNPAIRED) for i in ids], dtype=np.int64)

    def _associate(self, measured: FloatArray) -> IndexArray:
        if not len(self.landmarks) or not len(measured):
            return np.full(len(measured), UNPAIRED, dtype=np.int64)
        if self.config.method == "nearest":
            return self._nearest(measured)
        z, _, S = self._predicted(np.arange(len(self.landmarks)))
        noise = np.broadcast_to(self._noise, (len(measured), 2, 2))
        if self.config.method == "jcbb":
            return jcbb(measured, noise, JointPrediction(z, S), angles=(1,), confidence=self.config.confidence)
        distance, nis = self._distances(measured)
        possible = nis < chi_square_bound(self.config.confidence, 2)
        if self.config.method == "ccda":
            return self._combined(measured, possible, distance)
        return _one_to_one(np.where(possible, distance, np.inf))

    def _combined(self, measured: FloatArray, possible: npt.NDArray[np.bool_], costs: FloatArray) -> IndexArray:
        """Most pairs, each possible by itself (k, m), whose distances from each other agree (thesis 9.4.1)."""
        columns, rows = np.nonzero(possible)
        placed = [place(np.zeros(POSE_DIM), z) for z in measured]
        points = np.array([point for point, _, _ in placed])
        own = np.array([J @ self._noise @ J.T for _, _, J in placed])
        index = POSE_DIM + 2 * rows[:, None] + np.arange(2)
        joint = self.covariance.columns(index.ravel())[index.ravel()].reshape(len(rows), 2, len(rows), 2)
        fits = equal_distances(
            (self.landmarks[rows], distance_variances(self.landmarks[rows], joint)),
            (points[columns], distance_variances(points[columns], own[columns])),
            chi_square_bound(self.config.confidence, 1),
        )
        return ccda(rows, columns, costs[columns, rows], fits, len(measured))

    def _nearest(self, measured: FloatArray) -> IndexArray:
        points = np.array([place(self.pose, z)[0] for z in measured])
        distance = np.linalg.norm(points[:, None] - self.landmarks[None], axis=2)
        return _one_to_one(np.where(distance < self.config.nearest_associate, distance, np.inf))

    def _distances(self, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normalised distance of Eq. 4.8 and NIS of every measurement and landmark (k, m)."""
        z, _, joint = self._predicted(np.arange(len(self.landmarks)))
        m = len(z)
        S = joint.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m)] + self._noise
        innovation = measured[:, None] - z[None]
        innovation[..., 1] = wrap(innovation[..., 1])
        nis = np.einsum("kmi,mij,kmj->km", innovation, np.linalg.inv(S), innovation)
        return nis + np.linalg.slogdet(S)[1], nis

    def _new(self, measured: FloatArray, known: IndexArray) -> IndexArray:
        """Unpaired measurements that are far from every landmark; what lies between is discarded."""
        unpaired = np.flatnonzero(known == UNPAIRED)
        if not len(self.landmarks) or not len(unpaired):
            return unpaired
        nis = self._distances(measured[unpaired])[1]
        return np.asarray(unpaired[nis.min(axis=1) > chi_square_bound(self.config.new_confidence, 2)])


def _moved(points: FloatArray, shift: FloatArray, angle: float) -> FloatArray:
    """Apply a right-invariant error given in plain coordinates: ``shift`` (n, 2) of points (n, 2) and the rotation."""
    own = shift - angle * points @ _QUARTER_TURN.T
    sine, cosine = (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle) if abs(angle) > 1e-9 else (1.0, 0.5 * angle)
    J = np.array([[sine, -cosine], [cosine, sine]])
    return np.asarray(points @ turn(angle).T + own @ J.T)


def _one_to_one(costs: FloatArray) -> IndexArray:
    """Column of each row, cheapest pairs first, each column once; -1 where none is finite."""
    chosen = np.full(len(costs), UNPAIRED, dtype=np.int64)
    for flat in np.argsort(costs, axis=None, kind="stable"):
        row, column = divmod(int(flat), costs.shape[1])
        if not np.isfinite(costs[row, column]):
            break
        if chosen[row] == UNPAIRED and column not in chosen:
            chosen[row] = column
    return chosen
