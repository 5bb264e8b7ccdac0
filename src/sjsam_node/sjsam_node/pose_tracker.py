# SPDX-License-Identifier: Apache-2.0
"""Pose of an agent in the map at every pose of its odometry: the end of its newest joined submap, propagated.

    T_map_rig = T_map_end * (T_odom_end^-1 * T_odom_rig)

The end of a submap is known in the map; what has been driven since is the odometry's, whose covariance adds up from
submap to submap. The part since the end is therefore the difference of the two odometry covariances, and independent
of the end's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray, compose_covariance, compose_jacobians, invert_transform
from slam_core.nodes.stamp_guard import StampGuard
from slam_core.types import PoseEstimate

KEPT = 20000
"""Odometry poses remembered: more than a submap takes to be joined."""

_SMALLEST_VARIANCE = 1e-12
_SHRUNK = 0.5
"""An odometry whose covariance falls below this share of that at the end of a submap has begun anew."""


@dataclass(frozen=True, eq=False)
class _Anchor:
    """One instant in the map and in the odometry."""

    in_map: PoseEstimate
    in_odom: PoseEstimate


class PoseTracker:
    """Follows one agent.

    Parameters
    ----------
    T_map_odom
        Where the odometry begins in the map (4, 4), until a submap says it; None while that is not known.
    """

    def __init__(self, T_map_odom: FloatArray | None) -> None:
        self.T_map_odom = T_map_odom
        self._anchor: _Anchor | None = None
        self._odometry: dict[int, PoseEstimate] = {}
        self._newest: PoseEstimate | None = None
        self._stamps = StampGuard[PoseEstimate]()

    def add_odometry(self, pose: PoseEstimate) -> list[PoseEstimate]:
        """Poses in the map that an odometry pose T_odom_rig leads to.

        None while the agent's place is not known or the stamp is odd; several where it was taken for odd.
        """
        decision = self._stamps.add("odom", pose.stamp_ns, pose)
        found = [self._move_to(released) for _, released in decision.released]
        return [in_map for in_map in found if in_map is not None]

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry pose; None before the first."""
        return None if self._newest is None else self._newest.stamp_ns

    def newest_in_odom(self) -> PoseEstimate:
        """T_odom_rig: the newest pose of the odometry, else the newest end of a submap in it, else its origin."""
        if self._newest is not None:
            return self._newest
        return PoseEstimate(0, np.eye(4), np.zeros((6, 6))) if self._anchor is None else self._anchor.in_odom

    def map_to_odom(self) -> PoseEstimate | None:
        """T_map_odom with covariance, or None while it is not known.

        The covariance is that of the rig's pose in the map, carried to the odometry's origin: whoever takes the
        odometry as exact finds the rig with it as uncertain as it is.
        """
        rig = self.newest_in_odom()
        in_map = self.pose_of(rig)
        if in_map is None or self.T_map_odom is None:
            return None
        covariance = compose_covariance(in_map.T, in_map.covariance, invert_transform(rig.T), np.zeros((6, 6)))
        return PoseEstimate(rig.stamp_ns, self.T_map_odom, covariance)

    def lose(self) -> None:
        """Forget where the agent is in the map, until a submap says it again."""
        self.T_map_odom = self._anchor = None

    def _move_to(self, pose: PoseEstimate) -> PoseEstimate | None:
        if self._newest is not None and self._has_begun_anew(self._newest, pose):
            self._go_on_from(self.pose_of(self._newest), pose)
        self._newest = pose
        self._odometry[pose.stamp_ns] = pose
        if len(self._odometry) > KEPT:
            del self._odometry[next(iter(self._odometry))]
        return self.pose_of(pose)

    def has_heard(self, stamp_ns: int) -> bool:
        """True if the odometry pose of a stamp is known."""
        return stamp_ns in self._odometry

    def add_submap(self, end: PoseEstimate, in_odom: PoseEstimate | None = None) -> None:
        """Take the end of a joined submap in the map; ``in_odom`` is it in the odometry, where that was not heard."""
        in_odom = in_odom or self._odometry[end.stamp_ns]
        self._anchor = _Anchor(end, in_odom)
        self.T_map_odom = end.T @ invert_transform(in_odom.T)

    def pose_of(self, pose: PoseEstimate) -> PoseEstimate | None:
        """T_map_rig with covariance of an odometry pose T_odom_rig."""
        if self.T_map_odom is None:
            return None
        if self._anchor is None:
            zero = np.zeros((6, 6))
            covariance = compose_covariance(self.T_map_odom, zero, pose.T, pose.covariance)
            return PoseEstimate(pose.stamp_ns, self.T_map_odom @ pose.T, _positive(covariance))
        end, since = self._anchor.in_map, _since(self._anchor.in_odom, pose)
        covariance = compose_covariance(end.T, end.covariance, since.T, since.covariance)
        return PoseEstimate(pose.stamp_ns, end.T @ since.T, covariance)

    def _go_on_from(self, last: PoseEstimate | None, first: PoseEstimate) -> None:
        """The odometry has begun anew: the agent is where it was, as far as anybody knows."""
        self._odometry.clear()
        if last is None:
            return
        self._anchor = _Anchor(PoseEstimate(first.stamp_ns, last.T, last.covariance), first)
        self.T_map_odom = last.T @ invert_transform(first.T)

    def _has_begun_anew(self, before: PoseEstimate, now: PoseEstimate) -> bool:
        """Stamps go back, or the covariance is below that of a submap's end: from submap to submap it only grows."""
        if self._anchor is None:
            return False
        finished = self._anchor.in_odom.covariance
        return now.stamp_ns < before.stamp_ns or bool(np.trace(now.covariance) < _SHRUNK * np.trace(finished))


def _since(start: PoseEstimate, end: PoseEstimate) -> PoseEstimate:
    """Motion from one odometry pose to a later one; its covariance is by how much the odometry's has grown."""
    T = invert_transform(start.T) @ end.T
    J_start, J_motion = compose_jacobians(start.T, T)
    grown = end.covariance - J_start @ start.covariance @ J_start.T
    return PoseEstimate(end.stamp_ns, T, _positive(J_motion.T @ grown @ J_motion))


def _positive(covariance: FloatArray) -> FloatArray:
    """The nearest covariance (6, 6) none of whose variances is below the smallest."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.maximum(values, _SMALLEST_VARIANCE)) @ vectors.T)
