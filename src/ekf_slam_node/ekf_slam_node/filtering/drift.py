# SPDX-License-Identifier: Apache-2.0
"""Drift of odometry that no residual shows: what a frame's common error leaves behind in the map.

Of the error that all features of a frame have in common (:mod:`ekf_slam_node.filtering.correlated_noise`) a part does
not average out while the view changes: new landmarks are placed by frames that err, and rig and landmarks in view
move away together. Each frame adds a small rigid motion about the camera, a random walk. The filter cannot see it,
and its estimate stays; the poses that it gives out are as much less certain. Submaps are handed on without: with it
in their covariances, maps joined of recordings became up to 8 % less accurate.
"""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray, skew

_SHARE = 1.0
"""Drift of a frame in its common error: with it errors of the filter's poses on recordings are nearest to what is
claimed (``slam benchmark``).
"""


class Drift:
    """Sum of the rigid motions by which a submap has drifted since its start."""

    def __init__(self) -> None:
        self._shift = self._turn = 0.0
        self._first, self._second = np.zeros(3), np.zeros((3, 3))

    def add(self, common: FloatArray, place: FloatArray) -> None:
        """Take a frame: standard deviations (6,) of its common error, alike along all axes, and the camera's place."""
        shift, turn = (_SHARE * common[[0, 3]]) ** 2
        self._shift += shift
        self._turn += turn
        self._first += turn * place
        self._second += turn * np.outer(place, place)

    def covariance(self, place: FloatArray) -> FloatArray:
        """Covariance (6, 6) that the drift gives to the pose of a rig at a place (3,) of the submap."""
        arms = self._turn * place - self._first
        crossed = np.outer(place, self._first)
        squares = self._turn * np.outer(place, place) - crossed - crossed.T + self._second
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = (self._shift + np.trace(squares)) * np.eye(3) - squares
        covariance[:3, 3:] = -skew(arms)
        covariance[3:, :3] = covariance[:3, 3:].T
        covariance[3:, 3:] = self._turn * np.eye(3)
        return covariance
