# SPDX-License-Identifier: Apache-2.0
"""Gains by which the poses inside a submap follow its end, and the covariance that these leave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_core.geometry import FloatArray, skew
from slam_core.types import PoseEstimate, Submap


def smoothing_gains(submap: Submap, path: Sequence[PoseEstimate]) -> tuple[FloatArray, FloatArray]:
    """Gain by which a better end corrects each pose of a path, and the covariance of what it leaves, (n, 6, 6).

    A pose errs by what it hands on to the end, and by the noise of its own frame's measurement, which the end does not
    share. The first pose after the start shows the size of the latter: its covariance is that of two frames.

    Where the filter was less sure on the way than it is at the end (it has come back to landmarks of the start), most
    of what a pose erred by was made good before the end, which shares no more than the whole of its own error.
    """
    end_covariance = submap.covariance[:6, :6]
    stamps = np.array([pose.stamp_ns for pose in path])
    gain, remaining = np.zeros((len(path), 6, 6)), np.zeros((len(path), 6, 6))
    gain[stamps == submap.end_stamp_ns] = np.eye(6)
    between = np.nonzero((stamps != submap.end_stamp_ns) & (stamps != submap.start_stamp_ns))[0]
    if len(between):
        own = np.array([path[k].covariance for k in between.tolist()])
        handed_on = positive(own - 0.5 * submap.path[1].covariance)
        A: FloatArray = np.tile(np.eye(6), (len(between), 1, 1))  # the lever arm of what is left of the way
        A[:, :3, 3:] = -skew(submap.end_pose[:3, 3] - np.array([path[k].T[:3, 3] for k in between.tolist()]))
        shared = _capped(A @ handed_on @ transposed(A), end_covariance)
        gain[between] = np.linalg.solve(A, transposed(np.asarray(np.linalg.solve(end_covariance, shared))))
        left = gain[between] @ end_covariance @ transposed(gain[between])
        remaining[between] = positive(own - left)
    return gain, remaining


def transposed(A: FloatArray) -> FloatArray:
    """Matrices (..., m, n) transposed, (..., n, m)."""
    return np.swapaxes(A, -1, -2)


def _capped(covariance: FloatArray, largest: FloatArray) -> FloatArray:
    """The covariance, in no direction larger than another one, which is positive definite."""
    root = np.linalg.cholesky(largest)
    relative = np.linalg.solve(root, transposed(np.linalg.solve(root, covariance)))
    values, vectors = np.linalg.eigh(0.5 * (relative + transposed(relative)))
    half = root @ vectors
    return np.asarray((half * np.minimum(values, 1.0)[..., None, :]) @ transposed(half))


def positive(covariance: FloatArray) -> FloatArray:
    """Nearest positive definite matrix: eigenvalues no smaller than nothing much."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + transposed(covariance)))
    return np.asarray((vectors * np.maximum(values, 1e-12)[..., None, :]) @ transposed(vectors))
