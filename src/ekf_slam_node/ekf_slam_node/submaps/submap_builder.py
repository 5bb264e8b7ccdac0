# SPDX-License-Identifier: Apache-2.0
"""The submap that is being built (section 7.1): when it ends, what it hands over, how it chains to the one before."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import SubmapConfig
from ekf_slam_node.submaps.open_submap import OpenSubmap
from slam_core.geometry import FloatArray, boxminus, boxplus
from slam_core.linear_algebra import blas
from slam_core.types import ORIGIN_SIGMA, PoseEstimate, Submap

_MIN_FRAMES = 5
"""A submap has at least so many frames."""
_MIN_SHARED = 15
"""Landmarks seen in the last frame, below which the end is put off."""

_FOUND_AGAIN_S = 0.5
"""Age at which a submap that begins after a loss ends, so that the map soon hears of what it can be recognised by."""

_LEAST_EIGENVALUE = 1e-12
"""Share of the largest eigenvalue that rounding may reach."""


class SubmapBuilder:
    """Collects the poses inside one submap and makes the joint Gaussian of its end.

    Parameters
    ----------
    index, start_stamp_ns, follows_previous, session
        As in :class:`slam_core.types.Submap`.
    """

    def __init__(self, agent: str, index: int, start_stamp_ns: int, follows_previous: bool, session: int = 0) -> None:
        self._agent = agent
        self.index = index
        self._start_stamp_ns = start_stamp_ns
        self._follows_previous = follows_previous
        self._session = session
        self._path = [PoseEstimate(start_stamp_ns, np.eye(4), ORIGIN_SIGMA**2 * np.eye(6))]
        self._standing = 0
        self._bridged: list[PoseEstimate] = []

    def add_pose(self, pose: PoseEstimate, standing: bool = False) -> None:
        """Add the filter's present pose to the path; one of a rig that stands does not make the submap older."""
        self._standing += standing
        if self._bridged and self._bridged[-1].stamp_ns == pose.stamp_ns:
            self._path += smoothed(self._path[-1].stamp_ns, self._bridged, pose)
        self._bridged = []
        self._path.append(pose)

    @property
    def is_bridging(self) -> bool:
        """True if poses that no image confirms wait for one that ends them."""
        return bool(self._bridged)

    def add_bridged_pose(self, pose: PoseEstimate) -> None:
        """Add a pose that no image confirms, or the first after these as it was predicted.

        They are in the submap only if a pose of the filter ends them.
        """
        self._bridged.append(pose)

    def is_complete(self, local: OpenSubmap, config: SubmapConfig, shared: int) -> bool:
        """True if the rig is far enough from the start, or the submap large or old enough.

        Landmarks ``shared`` with the next submap hold the two together: with too few of them the end is put off, up to
        twice the limits. The first after a loss is old soon: the map may recognise its place.
        """
        is_lost = self.index > 0 and not self._follows_previous
        age = 1e-9 * (self._path[-1].stamp_ns - self._start_stamp_ns)
        size = max(
            float(np.linalg.norm(local.T[:3, 3])) / config.max_distance,
            len(local.table) / config.max_landmarks,
            (len(self._path) - self._standing) / config.max_frames,
            age / _FOUND_AGAIN_S if is_lost else 0.0,
        )
        limit = 1.0 if shared >= _MIN_SHARED else 2.0
        return len(self._path) >= _MIN_FRAMES and size > limit

    @property
    def is_empty(self) -> bool:
        """True if the submap has no pose beside its first."""
        return len(self._path) < 2

    def last_sound_pose(self) -> PoseEstimate:
        """The newest pose of the path whose numbers are finite."""
        sound = (p for p in reversed(self._path) if np.isfinite(p.T).all() and np.isfinite(p.covariance).all())
        return next(sound)

    def close(self, local: OpenSubmap) -> Submap:
        """The submap as it is now: its end pose is the last pose added."""
        landmarks, joint = local.close()
        covariance, table, end = _positive_definite(joint), local.table, self._path[-1]
        return Submap(
            agent=self._agent, index=self.index, start_stamp_ns=self._start_stamp_ns, end_stamp_ns=end.stamp_ns,
            end_pose=end.T, landmarks=landmarks, covariance=covariance, landmark_ids=table.ids.copy(),
            sightings=table.sightings.copy(), descriptors=table.descriptors.copy(), path=tuple(self._path),
            follows_previous=self._follows_previous, session=self._session,
        )  # fmt: skip


def smoothed(start_ns: int, bridged: list[PoseEstimate], end: PoseEstimate) -> list[PoseEstimate]:
    """The poses since ``start_ns`` that were ``bridged`` but for the last, corrected by what is known of it in the end.

    The error of a way found by accelerations grows with the square of time at most, that of the turn with time.
    """
    last = bridged[-1]
    error, excess = boxminus(end.T, last.T), last.covariance - end.covariance
    corrected = []
    for pose in bridged[:-1]:
        share = (pose.stamp_ns - start_ns) / (end.stamp_ns - start_ns)
        gain = np.repeat([share**2, share], 3)
        covariance = _positive_definite(pose.covariance - gain[:, None] * excess * gain)
        corrected.append(PoseEstimate(pose.stamp_ns, boxplus(pose.T, gain * error), covariance))
    return corrected


def _positive_definite(P: FloatArray) -> FloatArray:
    """A covariance whose smallest eigenvalues rounding has made negative, with these raised; others as they are."""
    if blas.cholesky(np.array(P.T, order="F")):
        return P
    values, vectors = np.linalg.eigh(P)
    return np.asarray((vectors * np.maximum(values, _LEAST_EIGENVALUE * values[-1])) @ vectors.T)
