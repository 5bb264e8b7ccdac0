# SPDX-License-Identifier: Apache-2.0
"""Locates an agent in a map that is not to change: by an initial pose or a look at the surroundings, then tracking.

A new submap is matched to the stored submaps around its predicted pose, or, without prediction, to those that look
like it, as far as chance would hardly make it look so. Between matches its odometry carries the pose on, with growing
covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sjsam_node.graph.links import Prior, Status
from sjsam_node.loop_closure.association import PointSet
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.smoothing.marginals import prior_of_pair
from slam_core.geometry import FloatArray, compose_covariance, inverse_jacobian, invert_transform
from slam_core.types import PoseEstimate, Submap

if TYPE_CHECKING:
    from sjsam_node.global_map import GlobalMap


@dataclass(frozen=True, eq=False)
class Localization:
    """Poses at the end of a submap and inside it in the map frame; None and empty while unknown.

    matched: landmarks of the map that were recognised.
    """

    pose: PoseEstimate | None
    matched: int
    path: tuple[PoseEstimate, ...] = ()


class Localizer:
    """Follows one agent through a map; the map stays as it is."""

    def __init__(self, global_map: GlobalMap) -> None:
        self._map = global_map
        self._pose: PoseEstimate | None = None

    def set_pose(self, pose: PoseEstimate) -> None:
        """Take the pose at which the agent is believed to be (``initialpose``), map frame."""
        self._pose = pose

    def process(self, submap: Submap) -> Localization:
        """Localise by one more submap of the agent; it must start where the one before ended, or follow a loss."""
        if not submap.follows_previous:
            self._pose = None
        start, matched = self._fix(submap)
        if start is None:
            self._pose = None
            return Localization(None, matched)
        self._pose = _moved(start, PoseEstimate(submap.end_stamp_ns, submap.end_pose, submap.covariance[:6, :6]))
        return Localization(self._pose, matched, tuple(_moved(start, pose) for pose in submap.path))

    def _fix(self, submap: Submap) -> tuple[PoseEstimate | None, int]:
        """Pose of the submap's start from the stored submap that matches best; the prediction where none does."""
        seen = PointSet(submap.landmarks, submap.covariance[6:, 6:], submap.descriptors)
        best, most = self._pose, 0
        verifier = self._map.detector.verifier
        for record in self._candidates(submap):
            known = at_start(self._map.estimate.graph.records[record])
            link, status = verifier.verify(known, seen, self._prior(record), 0.0, record)
            if link is None or len(link.pairs) <= most:
                continue
            if status is Status.CONSISTENT or (self._pose is None and verifier.is_evident(known, seen, link)):
                anchor = self._map.snapshot().start(record)
                covariance = compose_covariance(anchor.T, anchor.covariance, link.T, link.covariance)
                best, most = PoseEstimate(submap.start_stamp_ns, anchor.T @ link.T, covariance), len(link.pairs)
        return best, most

    def _candidates(self, submap: Submap) -> list[int]:
        detector, graph = self._map.detector, self._map.estimate.graph
        if self._pose is None:
            return detector.index.query(submap.descriptors, set())
        middle = self._pose.T[:3, :3] @ np.median(submap.landmarks, axis=0) + self._pose.T[:3, 3]
        return detector.around(middle, range(len(graph.records)), set())

    def _prior(self, record: int) -> Prior | None:
        if self._pose is None:
            return None
        anchor = self._map.snapshot().start(record)
        T = invert_transform(anchor.T)
        J = inverse_jacobian(anchor.T)
        covariance = compose_covariance(T, J @ anchor.covariance @ J.T, self._pose.T, self._pose.covariance)
        return prior_of_pair(T @ self._pose.T, covariance)


def _moved(start: PoseEstimate, pose: PoseEstimate) -> PoseEstimate:
    covariance: FloatArray = compose_covariance(start.T, start.covariance, pose.T, pose.covariance)
    return PoseEstimate(pose.stamp_ns, start.T @ pose.T, covariance)
