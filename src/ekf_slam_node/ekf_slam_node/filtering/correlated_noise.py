# SPDX-License-Identifier: Apache-2.0
"""The error that all features of a frame have in common, learnt from what neighbouring residuals share.

Pixel noise is fresh in every keypoint, so that eighty of them average it out. On real cameras a part is not: the
frame's rows are exposed one after the other, picture and depth were taken apart in time or registered to each other
with an error, lenses bend a little otherwise than their calibration says. Such errors are smooth over the image: the
residuals of neighbouring features agree about them, which fresh noise never does. What of a smooth error looks like a
motion of the camera has gone into the motion and is not among the residuals. It is the larger part, and is taken as a
multiple of what is left: an error of the camera's pose, new in every frame, that acts on all of its features
(``S += B B'``).

On simulated images of exact cameras neighbours share nothing, and the error is zero. On recordings they share 0.1 to
0.3 px; with 2.5 times that the errors of poses are as large as claimed (``benchmarks/chain/recordings.py``).
"""

from __future__ import annotations

import numpy as np

from ekf_slam_node.filtering.models import Frame
from slam_core.estimation.least_squares import MAD_TO_SIGMA, median
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

CORRELATED_NOISE_FACTOR = 2.5
"""Error of the camera's pose, new in every frame, in multiples of what the residuals of neighbouring features share."""
_NEIGHBOURS = 0.1
"""Features nearer than this share of the image's width are neighbours."""
_FORGETTING = 0.99
"""Weight of a frame after the next one: some hundred frames count."""
_CERTAIN = 3.0
"""Standard errors by which what neighbours share must exceed zero."""
_OUTLIER = 3.0
"""Residuals beyond so many robust standard deviations count as this large."""


class CorrelatedNoise:
    """Running estimate of the covariance (px2) that residuals of neighbouring features share.

    Parameters
    ----------
    factor
        Pose-like part of the error over the part that is left in the residuals; 0 switches it off.
    """

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self._sum = self._square_sum = self._weight = 0.0

    @property
    def shared_px(self) -> float:
        """Standard deviation of what neighbours share, px; 0 where that may be chance."""
        if self._weight == 0.0:
            return 0.0
        mean = self._sum / self._weight
        standard_error = np.sqrt(self._square_sum) / self._weight
        return float(np.sqrt(mean)) if mean > _CERTAIN * standard_error else 0.0

    def learn(self, pixels: FloatArray, residuals: FloatArray, width: int) -> None:
        """Take in the residuals (n, 2) px of a frame's features at pixels (n, 2), image ``width`` px wide."""
        if self._factor == 0.0 or len(pixels) < 2:
            return
        sizes = np.abs(residuals)
        spread = MAD_TO_SIGMA * np.array([median(sizes[:, 0]), median(sizes[:, 1])])
        r = np.clip(residuals, -_OUTLIER * spread, _OUTLIER * spread)
        order = np.argsort(pixels[:, 0])
        total, pairs = _shared_by_neighbours(pixels[order], r[order], _NEIGHBOURS * width)
        self._sum = _FORGETTING * self._sum + total
        # One frame's pairs share features and the frame's own error: each frame's sum counts as one draw.
        self._square_sum = _FORGETTING**2 * self._square_sum + total**2
        self._weight = _FORGETTING * self._weight + pairs

    def sigma(self, frame: Frame) -> FloatArray:
        """Standard deviations (6,) of the pose-like error of a frame: translation m, rotation rad.

        Turns and shifts that move the image of a point at the median distance by as much.
        """
        angle = self._factor * self.shared_px / frame.camera.fx
        distance = 1.0 / median(frame.z[:, 2]) if len(frame) else 0.0
        return np.repeat([angle * distance, angle], 3)


@in_place()
def _shared_by_neighbours(pixels, residuals, reach):  # type: ignore[no-untyped-def]
    """Sum, over all pairs of pixels (n, 2) nearer than ``reach``, of the residuals' mean product; number of pairs.

    Pixels come in the order of their first coordinate.
    """
    total, pairs = 0.0, 0
    for i in range(len(pixels)):
        for j in range(i + 1, len(pixels)):
            du, dv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            if du >= reach:
                break
            if du * du + dv * dv < reach * reach:
                total += 0.5 * (residuals[i, 0] * residuals[j, 0] + residuals[i, 1] * residuals[j, 1])
                pairs += 1
    return total, pairs
