# SPDX-License-Identifier: Apache-2.0
"""The submap that is being built (section 7.1): when it ends, what it hands over, how it chains to the one before."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import SubmapConfig
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.ride_filter import HeightAt
from ekf_slam_node.submaps.bridging import BridgedPose, positive_definite, smoothed
from ekf_slam_node.submaps.open_submap import OpenSubmap
from slam_core.types import ORIGIN_SIGMA, PoseEstimate, Submap

_MIN_FRAMES = 5
"""A submap has at least so many frames."""
_MIN_SHARED = 15
"""Landmarks seen in the last frame, below which the end is put off."""

_FOUND_AGAIN_S = 0.5
"""Age at which a submap that begins after a loss ends, so that the map soon hears of what it can be recognised by."""


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
        self._bridged: list[BridgedPose] = []
        self._located: list[PoseEstimate] = []
        self._mapping = 1

    def add_pose(self, pose: PoseEstimate, standing: bool = False) -> None:
        """Add the filter's present pose to the path; one of a rig that stands does not make the submap older."""
        self._standing += standing
        self._mapping += 1
        between = {p.stamp_ns: p for p in self._located if p.stamp_ns < pose.stamp_ns}
        if self._bridged and self._bridged[-1].stamp_ns == pose.stamp_ns:
            between |= {p.stamp_ns: p for p in smoothed(self._bridged, pose)}
        self._located, self._bridged = [], []
        self._path += [between[stamp] for stamp in sorted(between)]
        self._path.append(pose)

    def add_located_pose(self, pose: PoseEstimate) -> None:
        """Add a pose of a frame that maps nothing; it is in the submap once a pose of the filter follows."""
        self._located.append(pose)

    @property
    def is_bridging(self) -> bool:
        """True if poses that no image confirms wait for one that ends them."""
        return bool(self._bridged)

    def add_bridged_pose(self, pose: BridgedPose) -> None:
        """Add a pose that no image confirms, or the first after these as it was predicted.

        They are in the submap only if a pose of the filter ends them.
        """
        self._bridged.append(pose)

    def raise_path(self, heights: tuple[HeightAt, ...], up: UpDirection) -> None:
        """Raise the poses of a lift's way by its heights, which are interpolated; ``up`` along the submap's axes."""
        if not heights:
            return
        first, last = heights[0].stamp_ns, heights[-1].stamp_ns
        since = [at.stamp_ns - first for at in heights]
        for number, pose in enumerate(self._path):
            if number > 0 and first <= pose.stamp_ns <= last:
                after = pose.stamp_ns - first
                height = np.interp(after, since, [at.height for at in heights])
                variance = np.interp(after, since, [at.variance for at in heights])
                self._path[number] = up.raised(pose, float(height), float(variance))

    def replace_end(self, pose: PoseEstimate) -> None:
        """Replace the newest pose of the path."""
        self._path[-1] = pose

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
            (self._mapping - self._standing) / config.max_frames,
            age / _FOUND_AGAIN_S if is_lost else 0.0,
        )
        limit = 1.0 if shared >= _MIN_SHARED else 2.0
        return self._mapping >= _MIN_FRAMES and size > limit

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
        covariance, table, end = positive_definite(joint), local.table, self._path[-1]
        return Submap(
            agent=self._agent, index=self.index, start_stamp_ns=self._start_stamp_ns, end_stamp_ns=end.stamp_ns,
            end_pose=end.T, landmarks=landmarks, covariance=covariance, landmark_ids=table.ids.copy(),
            sightings=table.sightings.copy(), descriptors=table.descriptors.copy(), path=tuple(self._path),
            follows_previous=self._follows_previous, session=self._session,
        )  # fmt: skip
