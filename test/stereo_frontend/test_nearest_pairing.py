# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs and depth images of different stamps meet in the same way whatever the order of arrival."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from slam_core.camera import Camera, CameraInfo
from stereo_frontend.nearest_pairing import NearestPairing
from stereo_frontend.stereo.calibrated_pairs import CalibratedPairs

MS = 1_000_000


def pair_or_depth(milliseconds: float) -> SimpleNamespace:
    return SimpleNamespace(stamp_ns=round(milliseconds * MS))


def stamps(result):
    return [(p.stamp_ns / MS, None if d is None else d.stamp_ns / MS) for p, d in result]


def play(events, **options):
    pairing = NearestPairing("depth image", 0.03, **options)
    out = []
    for kind, time in events:
        out += (pairing.add_frame if kind == "pair" else pairing.add_companion)(pair_or_depth(time))
    return stamps(out + pairing.flush())


def test_the_nearest_depth_image_is_taken_whatever_the_order(rng):
    events = [("pair", t) for t in range(0, 1000, 100)] + [("depth", t) for t in range(-20, 1000, 40)]
    by_time = play(sorted(events, key=lambda e: e[1]))
    expected = [
        (float(t), float(min(range(-20, 1000, 40), key=lambda d: (abs(d - t), d)))) for t in range(0, 1000, 100)
    ]
    assert by_time == expected
    late_depth = sorted(events, key=lambda e: e[1] + (150 if e[0] == "depth" else 0))
    late_pairs = sorted(events, key=lambda e: e[1] + (25 if e[0] == "pair" else 0))
    assert play(late_depth) == play(late_pairs) == expected


def test_a_pair_without_a_depth_image_near_enough_goes_alone():
    assert play([("depth", 0), ("pair", 50), ("depth", 100)]) == [(50.0, None)]


def test_a_silent_depth_camera_holds_nothing_up():
    pairing = NearestPairing("depth image", 0.03, patience=2)
    released = [stamps(pairing.add_frame(pair_or_depth(t))) for t in (0, 100, 200, 300)]
    assert released == [[], [], [(0.0, None), (100.0, None), (200.0, None)], [(300.0, None)]]
    assert "no depth image" in pairing.diagnostic
    pairing.clear()
    assert pairing.flush() == []


def test_pairs_wait_for_both_camera_infos():
    info = CameraInfo(Camera(32, 24, 30.0, 30.0, 16.0, 12.0))
    pairs = CalibratedPairs[int](depth=2)
    for k in range(3):
        pairs.add(k)
    assert pairs.set_info("left", info)
    assert pairs.pop() is None
    assert pairs.set_info("right", info)
    assert [pairs.pop() for _ in range(3)] == [1, 2, None]
    assert pairs.dropped == 1
    assert not pairs.set_info("right", CameraInfo(info.camera))
    assert pairs.set_info("right", CameraInfo(info.camera, R=np.diag([1.0, -1.0, -1.0])))


@pytest.mark.parametrize("number", [0, 30])
def test_the_annotated_picture_marks_every_feature(stereo_pair, number):
    from stereo_frontend.detection.annotate import annotated_image
    from stereo_frontend.frontend import Frontend

    pair = stereo_pair()
    features = Frontend().process(pair).select(np.arange(number))
    picture = annotated_image(pair.left, features)
    assert picture.shape == (240, 320, 3)
    coloured = (picture.max(axis=2) != picture.min(axis=2)).any()
    assert coloured == (number > 0)
