# SPDX-License-Identifier: Apache-2.0
"""Choice of the frames that map; those between them tell the pose alone.

While nearly all that the last mapping frame showed is still in sight, a frame has little to add to the map: its
features are followed, which tells where the rig is, and nothing is detected in it and no depth measured. So the cost of
a map follows the motion, not the rate of the camera (as with the key frames of ORB-SLAM and SVO).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_core.camera import Camera
from slam_core.types import Float32Array
from stereo_frontend.assembly import MeasuredKeypoints
from stereo_frontend.tracking.tracker import Followed, IdArray, Tracker

_LEAST_KEPT = 0.85
"""Share of the tracks of the last mapping frame that are still followed, below which the next one maps."""
_MOST_FLOW = 0.06
"""Median way of these tracks since then, as a share of the image's width, above which the next one maps."""
_FRESHER_S = 5e-3
"""By how much a depth image is fresher to be worth a frame that maps."""
_TOLERANCE_S = 1e-3
"""Jitter of stamps."""


class MappingPace:
    """Decides frame by frame.

    ``interval_s`` is the time from one mapping frame to the next at which this one need not wait for motion; 0: all
    frames map.
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._stamp_ns: int | None = None
        self._age_s = np.inf
        self._ids: IdArray = np.zeros(0, np.int32)
        self._uv: Float32Array = np.zeros((0, 2), np.float32)

    def is_pose_only(
        self, tracker: Tracker, tracks: Followed, stamp_ns: int, camera: Camera, age_s: float = np.inf
    ) -> bool:
        """True if a frame in which these tracks were found need not map.

        ``age_s``: time between the frame and the depth image beside it, infinite without one. One that has a fresher
        depth image than the last mapping frame had maps, so that slower depth cameras are not passed over.
        """
        if age_s < self._age_s - _FRESHER_S:
            return False
        if self._stamp_ns is None or not 0.0 < 1e-9 * (stamp_ns - self._stamp_ns) < self._interval_s - _TOLERANCE_S:
            return False
        _, then, now = np.intersect1d(self._ids, tracks.ids, assume_unique=True, return_indices=True)
        known = np.isfinite(tracks.depth[now])
        then, now = then[known], now[known]
        if len(now) < _LEAST_KEPT * len(self._ids) or tracker.needs_key_frame(len(now)):
            return False
        flow = np.linalg.norm(tracks.keypoints.uv[now] - self._uv[then], axis=1)
        return float(np.median(flow)) < _MOST_FLOW * camera.width

    def mapped(self, stamp_ns: int, parts: Sequence[MeasuredKeypoints], age_s: float = np.inf) -> None:
        """Note a frame that maps, its tracks with depth, and the age of its depth image."""
        self._stamp_ns, self._age_s = stamp_ns, age_s
        usable = [np.flatnonzero((p.track_ids > 0) & np.isfinite(p.estimate.depth)) for p in parts]
        self._ids = np.concatenate([p.track_ids[i] for p, i in zip(parts, usable, strict=True)])
        self._uv = np.concatenate([p.keypoints.uv[i] for p, i in zip(parts, usable, strict=True)])
