# SPDX-License-Identifier: Apache-2.0
"""The filter: one joint Gaussian of the rig and its landmarks, its time update, augmentation and measurement update.

Error state: position, rotation, velocities (see ``models``), then three coordinates per landmark, all in the map frame.

**Consistency.** With landmark errors that stand alone, every update linearises the unobservable motion of the whole
map at another estimate and so invents information about heading. In the right-invariant error (Barrau and Bonnabel
2015; Zhang et al. 2017) landmark and position errors rotate with the rig's rotation error and this cannot happen. The
covariance is stored in the plain coordinates all the same, in which F and H stay sparse: after each update, which
moves point x by dx, the change of coordinates between the old and the new estimate is ``dx_error -= [dx]x
rotation_error``, a product of rank three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.filtering.covariance import Covariance, IndexArray, whiten
from ekf_slam_node.filtering.measurement_kernels import lower_innovation, seen_from_rig
from ekf_slam_node.filtering.models import (
    CORE_DIM,
    Observation,
    increment_jacobian,
    motion_jacobian,
    noise_gain,
    relative_motion,
    velocity_of_motion,
)
from ekf_slam_node.filtering.update_kernels import applied, sighted
from slam_core.camera import Camera
from slam_core.geometry import FloatArray, skew


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """Outcome of one measurement update: NIS, its degrees of freedom, whether it was applied."""

    nis: float
    dof: int
    applied: bool


@dataclass(frozen=True, eq=False)
class TimeUpdate:
    """A prediction that is not applied yet, linearised at a motion that may come from elsewhere than the velocity.

    T: (4, 4) the pose it is linearised at; velocity: (6,) the same for the velocities; offset: (12,) predicted mean
    minus linearisation point, zero unless a motion guess is used; head: (n, 12) predicted covariance of everything
    with the core; increment: (n, 6) covariance of everything with the motion of this step, for aids that measure it;
    increment_covariance (6, 6); increment_offset (6,).
    """

    T: FloatArray
    velocity: FloatArray
    offset: FloatArray
    head: FloatArray
    increment: FloatArray
    increment_covariance: FloatArray
    increment_offset: FloatArray


@dataclass(frozen=True, eq=False)
class Sighted:
    """Landmarks as they are predicted beside what is measured of them.

    innovation: (k, 3), ``z - h(x)``. nis: (k,), NaN where its covariance S is not positive. information: (k,), log
    det S less that of the measurement's noise: how much it tells of landmark and rig.
    """

    seen: Observation
    innovation: FloatArray
    nis: FloatArray
    information: FloatArray


class Ekf:
    """State and covariance of a rig and its landmarks, in the frame of the submap.

    The rig has a frame ``T`` and a body ``velocity``; landmarks are (m, 3).

    Parameters
    ----------
    velocity
        (6,) linear and angular, m/s and rad/s, in the rig frame; the pose is the identity.
    covariance
        Shape (12 + 3 m, 12 + 3 m) at the start.
    invariant
        Whether landmark errors rotate with the rig's rotation error.
    landmarks
        (m, 3) to start with; None for none.
    """

    def __init__(
        self, velocity: FloatArray, covariance: FloatArray, invariant: bool = True, landmarks: FloatArray | None = None
    ) -> None:
        self.T = np.eye(4)
        self.velocity = velocity.copy()
        self.landmarks = np.zeros((0, 3)) if landmarks is None else landmarks.copy()
        self.covariance = Covariance(covariance)
        self._invariant = invariant
        self._offset = np.zeros(self.covariance.size)

    # ------------------------------------------------------------------------------------------------------ time
    def time_update(self, dt: float, sigma: FloatArray, T_previous_now: FloatArray | None = None) -> TimeUpdate:
        """Predict dt (s) ahead with acceleration noise sigma (6,).

        With a motion guess, linearised there (iterated EKF).
        """
        at = self.velocity if T_previous_now is None else velocity_of_motion(T_previous_now, dt)
        F, R = motion_jacobian(self.T, at, dt), self.T[:3, :3]
        G, variance = noise_gain(R, at, dt), np.square(sigma)
        head = self.covariance.head(CORE_DIM)
        predicted = head @ F.T
        predicted[:CORE_DIM] = F @ predicted[:CORE_DIM] + (G * variance) @ G.T
        B, C = increment_jacobian(R, at, dt) * dt, G[:6]
        increment = head[:, 6:] @ B.T
        increment[:CORE_DIM] = F @ increment[:CORE_DIM] + (G * variance) @ C.T
        covariance = B @ head[6:12, 6:] @ B.T + (C * variance) @ C.T
        difference = self.velocity - at
        offset = np.concatenate([B @ difference, difference])
        return TimeUpdate(
            self.T @ relative_motion(at, dt), at, offset, predicted, increment, covariance, B @ difference
        )

    def apply_time_update(self, step: TimeUpdate) -> None:
        """Move the state to a prediction; a measurement update must follow if it was linearised at a guess."""
        self.T, self.velocity = step.T, step.velocity
        self._offset = np.concatenate([step.offset, np.zeros(self.covariance.size - CORE_DIM)])
        self.covariance.set_head(step.head)

    def update_increment(
        self, step: TimeUpdate, error: FloatArray, covariance: FloatArray, rows: slice, gate: float
    ) -> UpdateReport:
        """Measure the motion of the step just applied.

        Error (k,) of its rows (translation, rotation) in the map's axes.

        Not applied if its NIS is beyond the gate. The state stays where it is linearised, at the motion found from the
        landmarks: an update by them must follow, or :meth:`move_to_mean`.

        The previous pose is no part of the state: its place is taken by the covariance of everything with the step
        (stochastic cloning, Roumeliotis and Burdick 2002, with the clone marginalised at once).
        """
        S = step.increment_covariance[rows, rows] + covariance
        innovation = error - step.increment_offset[rows]
        nis = float(innovation @ np.linalg.solve(S, innovation))
        if not nis < gate:
            return UpdateReport(nis, len(innovation), False)
        return self._update(S, np.array(step.increment[:, rows], order="F"), innovation, stay=True)

    def restart(self, velocity: FloatArray, sigma: FloatArray) -> None:
        """Replace what is known of the velocities (6,) by these with standard deviations (6,)."""
        self.velocity = velocity.copy()
        head = self.covariance.head(CORE_DIM)
        head[:, 6:] = 0.0
        head[6:CORE_DIM] = 0.0
        head[6:CORE_DIM, 6:] = np.diag(sigma**2)
        self.covariance.set_head(head)

    def add_pose_noise(self, sigma: FloatArray) -> None:
        """Add an independent error of standard deviations (6,) to the pose."""
        head = self.covariance.head(6)
        head[:6] += np.diag(sigma**2)
        self.covariance.set_head(head)

    def displace(self, way: FloatArray, covariance: FloatArray) -> None:
        """Move the rig by a way (3,) that is known along its own axes, with an independent covariance (3, 3).

        The way turns with the error of the rig's orientation.
        """
        turned = -skew(way)
        head = self.covariance.head(6)
        head[:, :3] += head[:, 3:] @ turned.T
        head[:3] += turned @ head[3:6]
        head[:3, :3] += covariance
        self.covariance.set_head(head)
        self.T = self.T.copy()
        self.T[:3, 3] += way

    def move_to_mean(self) -> None:
        """Move the state from where it was linearised to its mean."""
        self._apply(np.zeros((self.covariance.size, 0), order="F"), np.zeros(0))

    # --------------------------------------------------------------------------------------------------- measurement
    def sighted(
        self, z: FloatArray, variance: FloatArray, slots: IndexArray, T_rig_optical: FloatArray, camera: Camera,
        common: FloatArray,
    ) -> Sighted:  # fmt: skip
        """Measurements z (k, 3) of variances (k, 3) of landmarks ``slots`` (k,) beside what is predicted of them.

        At the predicted mean, also where the prediction was linearised elsewhere. ``common``: as in :meth:`update`.
        """
        k = len(slots)
        seen = Observation(np.empty((k, 3)), np.empty(k), np.empty((k, 3, 6)), np.empty((k, 3, 3)))
        found = Sighted(seen, np.empty((k, 3)), np.empty(k), np.empty(k))
        sighted(
            self.covariance.buffer, self._offset, self.T, self.T @ T_rig_optical, self.landmarks,
            np.asarray(slots, dtype=np.int64), z, variance, common**2, camera.lens, seen.z, seen.depth, seen.J_pose,
            seen.J_point, found.innovation, found.nis, found.information,
        )  # fmt: skip
        return found

    def update(
        self,
        z: FloatArray,
        variance: FloatArray,
        seen: Observation,
        slots: IndexArray,
        common: FloatArray | None = None,
    ) -> UpdateReport:
        """Update with measurements z (m, 3) of variances (m, 3) of the landmarks ``slots`` (m,).

        They are predicted as ``seen`` (Eqs. 6.16-6.21). ``common`` (6,): standard deviations of an error of the
        camera's pose that all share.

        Without measurements, and where S cannot be factored, the state moves to its prediction and nothing is applied.
        """
        if not len(z):
            self.move_to_mean()
            return UpdateReport(0.0, 0, False)
        rows = CORE_DIM + 3 * np.asarray(slots, dtype=np.int64)
        cross = self.covariance.cross_covariance(seen.J_pose, seen.J_point, rows)
        S = np.empty((3 * len(rows),) * 2, order="F")
        shared = np.zeros(6) if common is None else common**2
        lower_innovation(seen.J_pose, seen.J_point, cross, rows, variance, shared, S)
        points = self._offset[CORE_DIM:].reshape(-1, 3)[slots]
        innovation = z - seen.z - seen.J_pose @ self._offset[:6] - np.einsum("mij,mj->mi", seen.J_point, points)
        return self._update(S, cross, innovation.ravel())

    def _update(self, S: FloatArray, cross: FloatArray, innovation: FloatArray, stay: bool = False) -> UpdateReport:
        whitened = whiten(S, cross, innovation)
        if whitened is None or not np.isfinite(whitened[1]).all():
            if not stay:
                self.move_to_mean()
            return UpdateReport(np.nan, len(innovation), False)
        W, y = whitened
        if stay:
            self.covariance.subtract_square(W)
            self._offset = self._offset + W @ y
        else:
            self._apply(W, y)
        return UpdateReport(float(y @ y), len(y), True)

    def _apply(self, W: FloatArray, y: FloatArray) -> None:
        """Move to the updated estimate; where errors rotate with the rig's, change coordinates, see the module."""
        self.T, self.velocity, self.landmarks = self.T.copy(), self.velocity.copy(), self.landmarks.copy()
        applied(self.covariance.buffer, W, y, self._offset, self.T, self.velocity, self.landmarks, self._invariant)
        self._offset = np.zeros(self.covariance.size)

    # -------------------------------------------------------------------------------------------------- augmentation
    def augment(self, points: FloatArray, covariances: FloatArray) -> IndexArray:
        """Add landmarks measured at (k, 3) in the rig frame with covariances (k, 3, 3).

        Returns their slots (Eqs. 6.22-6.24).
        """
        k, R = len(points), self.T[:3, :3]
        arms = points @ R.T
        self.covariance.append_points(arms, R @ covariances @ R.T)
        self._offset = np.zeros(self.covariance.size)
        self.landmarks = np.vstack([self.landmarks, arms + self.T[:3, 3]])
        return np.arange(len(self.landmarks) - k, len(self.landmarks))

    def remove(self, slot: int) -> None:
        """Marginalise a landmark; the last one takes its slot."""
        self.covariance.remove(CORE_DIM + 3 * slot, 3)
        self.landmarks[slot] = self.landmarks[-1]
        self.landmarks = self.landmarks[:-1]
        self._offset = np.zeros(self.covariance.size)

    def given_pose(self, slots: IndexArray) -> Ekf:
        """Landmarks ``slots`` and velocity given the rig's pose, in the rig's frame (Eq. 7.1).

        ``P_ll - P_lr P_rr^-1 P_rl`` is what would be known of them if the pose were known exactly.
        """
        R, t = self.T[:3, :3], self.T[:3, 3]
        rows = np.concatenate([np.arange(6, CORE_DIM), (CORE_DIM + 3 * slots[:, None] + np.arange(3)).ravel()])
        columns = self.covariance.columns(rows)
        given = np.linalg.solve(self.pose_covariance(), columns[:6])
        conditional = columns[rows] - columns[:6].T @ given
        turn = np.kron(np.eye(len(slots) + 2), R.T)
        turn[:6, :6] = np.eye(6)
        start = np.zeros((6 + len(conditional),) * 2)
        start[6:, 6:] = turn @ conditional @ turn.T
        return Ekf(self.velocity, start, self._invariant, (self.landmarks[slots] - t) @ R)

    # ------------------------------------------------------------------------------------------------------- views
    def pose_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the rig's pose."""
        return np.asarray(self.covariance.blocks(np.array([0]), 6)[0])

    def velocity_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the rig's velocities."""
        return np.asarray(self.covariance.blocks(np.array([6]), 6)[0])

    @property
    def is_finite(self) -> bool:
        """True if the mean and the rig's covariance with everything are finite numbers."""
        parts = (self.T, self.velocity, self.landmarks, self.covariance.head(CORE_DIM))
        return all(bool(np.isfinite(part).all()) for part in parts)

    def landmarks_in_rig(self) -> tuple[FloatArray, FloatArray]:
        """Landmarks as the rig has them around itself: positions (m, 3) in the rig frame and covariances (m, 3, 3)."""
        m = len(self.landmarks)
        points, covariances = np.empty((m, 3)), np.empty((m, 3, 3))
        blocks = self.covariance.blocks(CORE_DIM + 3 * np.arange(m))
        seen_from_rig(self.landmarks, blocks, self.T, self.covariance.head(6), CORE_DIM, points, covariances)
        return points, covariances
