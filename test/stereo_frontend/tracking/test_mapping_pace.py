# SPDX-License-Identifier: Apache-2.0
"""Frames that map, and those between them that tell the pose alone."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from stereo_frontend.assembly import DepthEstimate, MeasuredKeypoints
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.tracking.mapping_pace import MappingPace
from stereo_frontend.tracking.tracker import Followed, Tracker

CAMERA = Camera(640, 480, 400.0, 400.0, 320.0, 240.0)


class Satisfied(Tracker):
    """A tracker that never asks for a key frame."""

    def needs_key_frame(self, measured: int) -> bool:
        return False


def keypoints(uv: np.ndarray) -> Keypoints:
    n = len(uv)
    return Keypoints(
        uv.astype(np.float32), np.ones(n, np.float32), np.ones(n, np.float32), np.zeros((n, 4), np.float32)
    )


def tracks(uv: np.ndarray, ids: np.ndarray, depth: float = 2.0) -> Followed:
    n = len(ids)
    return Followed(np.arange(n), keypoints(uv), ids, np.ones((n, 2), np.float32), np.full(n, depth))


def pace_after(uv: np.ndarray, ids: np.ndarray, interval_s: float = 0.2, age_s: float = np.inf) -> MappingPace:
    pace, n = MappingPace(interval_s), len(ids)
    estimate = DepthEstimate(np.full(n, 2.0), np.full(n, 0.1), np.zeros(n, np.uint8))
    pace.mapped(1_000_000_000, [MeasuredKeypoints(keypoints(uv), estimate, np.ones((n, 2), np.float32), ids)], age_s)
    return pace


@pytest.mark.parametrize(
    ("after_s", "kept", "flow", "interval_s", "expected"),
    [
        (0.1, 100, 5.0, 0.2, True),
        (0.2, 100, 5.0, 0.2, False),  # the time is over
        (0.1, 80, 5.0, 0.2, False),  # too few are still in sight
        (0.1, 100, 50.0, 0.2, False),  # too far from where they were
        (0.1, 100, 5.0, 0.0, False),  # all frames map
        (-0.1, 100, 5.0, 0.2, False),  # time has jumped back
    ],
)
def test_a_frame_need_not_map_while_the_last_one_is_in_sight(rng, after_s, kept, flow, interval_s, expected):
    uv, ids = rng.uniform(0, 400, (100, 2)), np.arange(1, 101, dtype=np.int32)
    pace = pace_after(uv, ids, interval_s)
    now = tracks(uv[:kept] + np.array([flow, 0.0]), ids[:kept])
    stamp = 1_000_000_000 + int(after_s * 1e9)
    assert pace.is_pose_only(Satisfied(150), now, stamp, CAMERA) is expected


def test_tracks_without_depth_and_missing_ones_do_not_count(rng):
    uv, ids = rng.uniform(0, 400, (100, 2)), np.arange(1, 101, dtype=np.int32)
    pace, stamp = pace_after(uv, ids), 1_100_000_000
    assert not pace.is_pose_only(Satisfied(150), tracks(uv, ids, np.nan), stamp, CAMERA)
    assert not pace.is_pose_only(Satisfied(150), tracks(uv, ids + 1000), stamp, CAMERA)
    assert not pace.is_pose_only(Tracker(500), tracks(uv, ids), stamp, CAMERA), "the tracker wants a key frame"
    pace.reset()
    assert not pace.is_pose_only(Satisfied(150), tracks(uv, ids), stamp, CAMERA)


def test_a_frame_with_a_fresher_depth_image_maps(rng):
    uv, ids = rng.uniform(0, 400, (100, 2)), np.arange(1, 101, dtype=np.int32)
    pace = pace_after(uv, ids, age_s=0.05)
    for age_s, expected in ((0.05, True), (np.inf, True), (0.0, False)):
        assert pace.is_pose_only(Satisfied(150), tracks(uv, ids), 1_050_000_000, CAMERA, age_s) is expected
