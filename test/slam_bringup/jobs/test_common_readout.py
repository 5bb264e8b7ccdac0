# SPDX-License-Identifier: Apache-2.0
"""The readout of a rolling shutter that recordings of one camera share, and when they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_bringup.jobs.common_readout import SeenReadout, camera_key, readouts_of_others
from slam_core.camera import Camera, CameraInfo

INFO = CameraInfo(Camera(640, 480, 500.0, 500.0, 320.0, 240.0))
KEY = camera_key(INFO)


def seen(value_ms: float, sigma_ms: float, camera: str = KEY) -> SeenReadout:
    return SeenReadout(camera, 1e-3 * value_ms, 1e-3 * sigma_ms)


def test_a_recording_gets_the_weighted_mean_of_the_others_and_not_its_own():
    first, second, third = readouts_of_others([seen(10.0, 2.0), seen(12.0, 1.0), seen(9.0, 1.0)])
    assert first is not None
    assert second is not None
    assert third is not None
    assert first.value_s == pytest.approx(10.5e-3)
    assert first.sigma_s == pytest.approx(1e-3 / np.sqrt(2.0))
    assert second.value_s == pytest.approx((10.0 / 4 + 9.0) / 1.25 * 1e-3)
    assert first.parameters["ekf_slam"]["measurement.readout"] == first.value_s
    assert "10.5 +- 0.7 ms" in first.text


def test_several_that_are_not_certain_alone_are_together():
    alone = readouts_of_others([seen(0.0, 0.0), seen(10.0, 2.0)])
    assert alone == [None, None]
    together = readouts_of_others([seen(0.0, 0.0), *[seen(10.0, 2.0)] * 4])
    assert together[0] is not None
    assert together[0].sigma_s == pytest.approx(1e-3)


@pytest.mark.parametrize(
    "others",
    [
        [seen(1.0, 0.5)],  # not certain
        [seen(20.0, 1.0)],  # the recording contradicts it
        [seen(5.0, 0.5, "another camera")],
        [],
    ],
)
def test_what_is_not_certain_or_not_of_the_camera_or_contradicted_is_not_shared(others):
    assert readouts_of_others([seen(4.0, 3.0), *others])[0] is None


def test_a_recording_that_shares_nothing_neither_gives_nor_gets():
    assert readouts_of_others([seen(10.0, 1.0, ""), seen(10.0, 1.0, "")]) == [None, None]


def test_cameras_are_told_apart_by_their_calibration():
    assert camera_key(CameraInfo(replace(INFO.camera))) == KEY
    for other in (
        CameraInfo(replace(INFO.camera, fx=501.0)),
        CameraInfo(replace(INFO.camera, distortion_model="plumb_bob", distortion=(0.1, 0.0, 0.0, 0.0, 0.0))),
        replace(INFO, P=np.array([[500.0, 0, 320, -50], [0, 500, 240, 0], [0, 0, 1, 0]])),
    ):
        assert camera_key(other) != KEY
    assert camera_key(None) == ""


def test_the_order_of_recordings_does_not_matter():
    rng = np.random.default_rng(0)
    for _ in range(50):
        given = [seen(*values) for values in rng.uniform([8.0, 0.5], [12.0, 2.0], (5, 2))]
        assert readouts_of_others(given) == readouts_of_others(given[::-1])[::-1]
