# SPDX-License-Identifier: Apache-2.0
"""Association of a frame with what is known, under what IMU and odometry say of the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ekf_slam_node.association.linking import CONVINCING, FrameLink, Linker
from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.filtering.candidates import Candidates, MotionPrior, motion_prior
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.odometry.relative_poses import (
    ALL,
    RELATIVE_POSE_GATE,
    RelativePoseBuffer,
    RelativePoseMeasurement,
    contradicts,
)
from ekf_slam_node.submaps.motion_checks import fused_prior
from ekf_slam_node.submaps.rolling_shutter import RollingShutter
from ekf_slam_node.submaps.steps import Associated
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.types import Counters

MOVING = "moving_objects"
"""Name of things that move in the counters: ``frames_with_moving_objects``, ``features_on_moving_objects``."""


@dataclass(frozen=True, eq=False)
class FrameAssociation:
    """Associates frames of :class:`~ekf_slam_node.slam.EkfSlam` with the open submap of its chain."""

    config: EkfSlamConfig
    chain: SubmapChain
    aids: RelativePoseBuffer
    linker: Linker
    shutter: RollingShutter
    counters: Counters

    def of(self, frame: Frame, dt: float, aid: RelativePoseMeasurement | None, maps: bool = True) -> Associated | None:
        """Pairs of a frame's features with what is known, and their motion; None if nothing fits.

        ``maps``: as in :meth:`~ekf_slam_node.association.linking.Linker.link`.
        """
        local = self.chain.local
        expected = motion_prior(local.velocity, local.velocity_covariance(), self.config.motion.sigma, dt)
        prior = fused_prior(expected, aid)
        predicted = self.shutter.corrected(frame, dt, None if aid is None else prior.T)
        candidates = local.candidates()
        is_refuted = partial(self._is_inconsistent, frame.stamp_ns, maps)
        link = self.linker.link(candidates, predicted, prior, is_refuted, maps=maps)
        if link is not None:
            link = self._without_moving(frame.stamp_ns, candidates, predicted, expected, link, maps)
        return None if link is None else Associated(link, expected, prior)

    def _without_moving(
        self, stamp_ns: int, candidates: Candidates, frame: Frame, expected: MotionPrior, link: FrameLink, maps: bool
    ) -> FrameLink | None:
        """The link, or where the IMU contradicts it that of the features which agree with the IMU, if there are any.

        None if there are not, and few features have made the link: the IMU bridges the frame.
        """
        told = self.aids.witness(self.chain.stamp_ns, stamp_ns)
        if told is None:
            return link
        if not contradicts(told, link.T, link.covariance, RELATIVE_POSE_GATE):
            return replace(link, is_sure=True)
        dt = seconds_between(self.chain.stamp_ns, stamp_ns)
        other = self.linker.link_at(candidates, frame, fused_prior(expected, told), link.variance_scale)
        if other is None or contradicts(told, other.T, other.covariance, RELATIVE_POSE_GATE):
            is_convincing = len(link.rows) >= CONVINCING * min(len(candidates), len(frame))
            if told.rows != ALL or is_convincing or self.aids.suspects_ride(told, link.T, dt):
                return link
            if maps:
                self.aids.add_inconsistency(stamp_ns)
                self.counters.add("links_refuted")
            return None
        moving = np.setdiff1d(link.columns, other.columns)
        if maps:
            self.linker.mark_moving(frame, moving)
        return replace(other, moving=link.moving + len(moving))  # which the IMU is sure of

    def _is_inconsistent(self, stamp_ns: int, maps: bool, link: FrameLink) -> bool:
        """True if looks alone have led to a place where the IMU says that the rig cannot be."""
        if not self.aids.is_inconsistent(self.chain.stamp_ns, stamp_ns, link.T, link.covariance):
            return False
        self.counters.add("links_refuted", int(maps))
        return True
