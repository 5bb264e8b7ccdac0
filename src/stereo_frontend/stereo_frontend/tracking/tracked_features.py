# SPDX-License-Identifier: Apache-2.0
"""Features of one frame by tracking: those that were followed, and new ones in a key frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from slam_core.camera import Camera
from slam_core.types import ByteArray, Float32Array
from stereo_frontend.assembly import DepthEstimate, MeasuredKeypoints
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.tracking.tracker import Followed, Tracker

_SHARE = 0.5
"""Share of the keypoints' noise in that of their tracks.

A patch is followed to hundredths of a pixel, but the keypoint in it lies elsewhere when it is detected anew, by which
submaps are joined: landmarks as sure as the patch contradict each other (two_rooms 4.3 to 7.9 mm, ANEES 1.4 to 3.7).
"""


PREDICTED_SIGMA = 0.25
"""Standard deviation, as a share of depth, of a predicted depth in place of a measured one.

It says next to nothing, so that such a track measures a direction alone.
"""

Noise = Callable[[Float32Array], Float32Array]
"""Standard deviations (n,) px of keypoints by their size (n,) px."""


def followed(
    tracker: Tracker, tracks: Followed, estimate: DepthEstimate, camera: Camera, noise: Noise
) -> MeasuredKeypoints:
    """Features of the ``tracks`` (n), which have the depths of ``estimate`` (n); the tracker learns these."""
    tracker.measured(tracks, estimate.depth, camera)
    return _measured(tracks, estimate, noise)


def pose_only(tracks: Followed, noise: Noise) -> MeasuredKeypoints:
    """Features of the ``tracks`` (n) of a frame in which no depth is measured: directions, with predicted depths."""
    estimate = DepthEstimate.unknown(len(tracks.ids)).completed(tracks.depth, PREDICTED_SIGMA)
    return _measured(tracks, estimate, noise)


def _measured(tracks: Followed, estimate: DepthEstimate, noise: Noise) -> MeasuredKeypoints:
    sigma = np.hypot(tracks.sigma_uv, _SHARE * noise(tracks.keypoints.size)[:, None])
    return MeasuredKeypoints(tracks.keypoints, estimate, sigma.astype(np.float32), tracks.ids)


def begun(
    tracker: Tracker,
    number: int,
    picture: ByteArray,
    keypoints: Keypoints,
    estimate: DepthEstimate,
    camera: Camera,
    noise: Noise,
) -> MeasuredKeypoints:
    """Features of the keypoints of a key frame where nothing is followed yet; tracks begin there.

    ``number`` of tracks were measured in it: where that is too few to go on, keypoints without a track count, too.
    """
    free = np.flatnonzero(tracker.is_free(keypoints.uv))
    keypoints, estimate = keypoints.select(free), estimate.select(free)
    ids = tracker.begin(picture, keypoints, estimate.depth, camera)
    if not tracker.has_lost_sight(number):
        estimate.depth[ids == 0] = np.nan
    return dataclasses.replace(MeasuredKeypoints.untracked(keypoints, estimate, noise(keypoints.size)), track_ids=ids)
