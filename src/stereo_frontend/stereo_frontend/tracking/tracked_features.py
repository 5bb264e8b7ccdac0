# SPDX-License-Identifier: Apache-2.0
"""Features of one frame by tracking: those that were followed, and new ones in a key frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_core.camera import Camera
from slam_core.types import ByteArray, Float32Array
from stereo_frontend.assembly import DepthEstimate
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.tracking.tracker import Followed, IdArray, Tracker

_SHARE = 0.5
"""Share of the keypoints' noise in that of their tracks.

A patch is followed to hundredths of a pixel, but the keypoint in it lies elsewhere when it is detected anew, by which
submaps are joined: landmarks as sure as the patch contradict each other (two_rooms 4.3 to 7.9 mm, ANEES 1.4 to 3.7).
"""


@dataclass(frozen=True, eq=False)
class MeasuredKeypoints:
    """Keypoints (n) with their depth, sigma_uv (n, 2) px, and track_ids (n,), 0 of those that are not followed."""

    keypoints: Keypoints
    estimate: DepthEstimate
    sigma_uv: Float32Array
    track_ids: IdArray


def follow_or_detect(
    tracker: Tracker,
    picture: ByteArray,
    camera: Camera,
    stamp_ns: int,
    measure: Callable[[Followed], DepthEstimate],
    detect: Callable[[], tuple[Keypoints, DepthEstimate]],
    noise: Callable[[Float32Array], Float32Array],
    mask: ByteArray | None = None,
) -> list[MeasuredKeypoints]:
    """Features that were followed into a picture, and where that is too little, what is new in it.

    ``measure`` gives the depth of what was followed, ``detect`` keypoints with depth, ``noise`` the
    standard deviations (n,) px of keypoints by their size (n,) px. Nothing is followed where ``mask`` is not zero.
    """
    parts = []
    number = 0
    followed = tracker.follow(picture, camera, stamp_ns, mask)
    if followed is not None:
        estimate = measure(followed)
        tracker.measured(followed, estimate.depth, camera)
        number = int(np.isfinite(estimate.depth).sum())
        sigma = np.hypot(followed.sigma_uv, _SHARE * noise(followed.keypoints.size)[:, None])
        parts.append(MeasuredKeypoints(followed.keypoints, estimate, sigma.astype(np.float32), followed.ids))
    if tracker.needs_key_frame(number):
        keypoints, estimate = detect()
        free = np.flatnonzero(tracker.is_free(keypoints.uv))
        keypoints, estimate = keypoints.select(free), estimate.select(free)
        ids = tracker.begin(picture, keypoints, estimate.depth, camera)
        if not tracker.has_lost_sight(number):
            estimate.depth[ids == 0] = np.nan
        sigma = np.repeat(noise(keypoints.size)[:, None], 2, axis=1)
        parts.append(MeasuredKeypoints(keypoints, estimate, sigma, ids))
    return parts
