"""Motion from elsewhere: scan registration between two frames, the turn rate of an IMU (thesis 9.4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.config import MotionConfig
from slam_core.geometry import FloatArray, compose_covariance, make_transform, so3_exp, so3_log
from slam_core.types import ImuSample, RelativeMotion

ALL = slice(0, 6)
ROTATION = slice(3, 6)


@dataclass(frozen=True, eq=False)
class Aid:
    """A measured motion T = T_previous_now; ``rows`` of its error are known, with their covariance (k, k)."""

    T: FloatArray
    covariance: FloatArray
    rows: slice


class MotionAids:
    """Collects aids between two frames of the filter."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._motion: RelativeMotion | None = None
        self._samples: list[ImuSample] = []

    def add_motion(self, motion: RelativeMotion) -> bool:
        """Take a motion; chained to the ones before if it continues them. False if it is not finite or not positive
        definite.
        """
        if not _is_usable(motion):
            return False
        last = self._motion
        if last is not None and self._is_same_time(last.end_stamp_ns, motion.start_stamp_ns):
            covariance = compose_covariance(last.T, last.covariance, motion.T, motion.covariance)
            motion = RelativeMotion(last.start_stamp_ns, motion.end_stamp_ns, last.T @ motion.T, covariance)
        self._motion = motion
        return True

    def add_imu(self, sample: ImuSample) -> bool:
        """Take an IMU reading; False if it is not finite or not newer than the last."""
        newer = not self._samples or sample.stamp_ns > self._samples[-1].stamp_ns
        if not (newer and np.isfinite(sample.angular_velocity).all()):
            return False
        self._samples.append(sample)
        return True

    def between(self, start_stamp_ns: int, end_stamp_ns: int) -> Aid | None:
        """The best aid that covers the time between two stamps."""
        motion = self._motion
        if (
            motion is not None
            and self._is_same_time(motion.start_stamp_ns, start_stamp_ns)
            and self._is_same_time(motion.end_stamp_ns, end_stamp_ns)
        ):
            return Aid(motion.T, motion.covariance, ALL)
        return self._rotation_between(start_stamp_ns, end_stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what lies before the frame the filter has reached."""
        if self._motion is not None and self._motion.end_stamp_ns <= stamp_ns:
            self._motion = None
        # One sample from before stays: it holds until the next one.
        older = sum(sample.stamp_ns <= stamp_ns for sample in self._samples)
        del self._samples[: max(older - 1, 0)]

    def _rotation_between(self, start_stamp_ns: int, end_stamp_ns: int) -> Aid | None:
        stamps = np.array([sample.stamp_ns for sample in self._samples], dtype=np.int64)
        inside = (stamps > start_stamp_ns) & (stamps < end_stamp_ns)
        gap_limit = 0.5 * (end_stamp_ns - start_stamp_ns)
        if len(stamps) < 2 or stamps[0] > start_stamp_ns + gap_limit or stamps[-1] < end_stamp_ns - gap_limit:
            return None
        edges = np.concatenate([[start_stamp_ns], stamps[inside], [end_stamp_ns]])
        rates = np.array([sample.angular_velocity for sample in self._samples])
        middle = 0.5 * (edges[1:] + edges[:-1]) - stamps[0]
        rotation = np.eye(3)
        for when, dt in zip(middle, np.diff(edges) * 1e-9, strict=True):
            rate = [np.interp(when, stamps - stamps[0], rates[:, axis]) for axis in range(3)]
            rotation = rotation @ so3_exp(np.array(rate) * dt)
        sigma = self._config.sigma_gyro * (end_stamp_ns - start_stamp_ns) * 1e-9
        return Aid(make_transform(rotation, np.zeros(3)), np.eye(3) * sigma**2, ROTATION)

    def _is_same_time(self, a: int, b: int) -> bool:
        return abs(a - b) <= self._config.aid_stamp_tolerance * 1e9


def aid_error(aid: Aid, T_previous_now: FloatArray, rotation_map_previous: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Error (k,) of a motion as an aid sees it, along the map's axes, and its covariance (k, k)."""
    error = np.concatenate([aid.T[:3, 3] - T_previous_now[:3, 3], so3_log(aid.T[:3, :3] @ T_previous_now[:3, :3].T)])
    turn = np.kron(np.eye(2), rotation_map_previous)
    rows = turn[aid.rows, aid.rows]
    return (turn @ error)[aid.rows], rows @ aid.covariance @ rows.T


def _is_usable(motion: RelativeMotion) -> bool:
    finite = np.isfinite(motion.T).all() and np.isfinite(motion.covariance).all()
    return bool(
        finite and motion.end_stamp_ns > motion.start_stamp_ns and np.linalg.eigvalsh(motion.covariance)[0] > 0.0
    )
