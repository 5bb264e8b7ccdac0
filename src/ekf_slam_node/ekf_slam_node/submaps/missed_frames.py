# SPDX-License-Identifier: Apache-2.0
"""Frames that fit the map nowhere: two of them that fit each other begin a new submap."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.association.linking import Linker
from ekf_slam_node.config import MotionConfig
from ekf_slam_node.filtering.candidates import motion_prior
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.submaps.open_submap import candidate_landmarks
from slam_core.geometry import FloatArray

_LOST_FRAMES = 2
"""Frames without association after which a new submap may start."""


class MissedFrames:
    """Remembers the last frame without a link, and how many there were in a row."""

    def __init__(self, linker: Linker, T_rig_optical: FloatArray, motion: MotionConfig) -> None:
        self._linker = linker
        self._T_rig_optical = T_rig_optical
        self._motion = motion
        self._last: Frame | None = None
        self._count = 0

    @property
    def last(self) -> Frame | None:
        """The newest frame, if it had no link."""
        return self._last

    def clear(self) -> None:
        """A frame was linked."""
        self._last, self._count = None, 0

    def add(self, frame: Frame) -> Frame | None:
        """Take a frame without a link; returns the one before if the two fit and the map has been lost for long."""
        before, self._last = self._last, frame
        self._count += 1
        is_long = self._count >= _LOST_FRAMES
        return before if before is not None and is_long and self._link(before, frame) else None

    def _link(self, first: Frame, second: Frame) -> bool:
        dt = seconds_between(first.stamp_ns, second.stamp_ns)
        prior = motion_prior(np.zeros(6), np.diag(self._motion.initial_variance), self._motion.sigma, dt)
        return self._linker.link(candidate_landmarks(first, self._T_rig_optical).candidates, second, prior) is not None
