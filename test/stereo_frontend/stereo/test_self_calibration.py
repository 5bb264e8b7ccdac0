# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of a pair whose right camera is turned out of its calibration by a known rotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.config import from_mapping
from slam_core.geometry import make_transform, so3_exp, so3_log
from slam_core.types import StereoImages
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.stereo.corrected_info import corrected_right
from stereo_frontend.stereo.rectification_error import NAMES, RectificationError
from stereo_frontend.stereo.rectify import rectification_map
from stereo_frontend.stereo.self_calibration import SelfCalibrationConfig, StereoSelfCalibration
from stereo_frontend.stereo.two_view_consistency import StereoView, match_views

STEREO = StereoCamera(Camera(640, 480, 400.0, 400.0, 320.0, 240.0), 0.12)
TURN = np.radians([0.15, 0.3, -0.2])
PIXEL, DISPARITY, ROW = 0.15, 0.06, 0.05


class Walk:
    """Views of a room by a pair whose right camera is turned by ``turn`` (rotation vector, rad), seen from frame to
    frame.
    """

    def __init__(self, turn: np.ndarray, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._turn = so3_exp(turn)
        self._points = self._rng.uniform([-6.0, -2.0, 1.0], [6.0, 2.0, 9.0], (2500, 3))
        looks = self._rng.standard_normal((len(self._points), 32)).astype(np.float32)
        self._looks = looks / np.linalg.norm(looks, axis=1, keepdims=True)

    def views(self, frames: int) -> list[StereoView]:
        return [self._view(k) for k in range(frames)]

    def _view(self, k: int) -> StereoView:
        turn = np.array([0.03 * np.sin(k), 0.05 * np.sin(0.7 * k), 0.02 * k % 0.1])
        T = make_transform(so3_exp(turn), np.array([0.12 * np.sin(0.3 * k), 0.03 * np.sin(k), -0.08 * k]))
        c, rng = STEREO.camera, self._rng
        left_points = self._points @ T[:3, :3].T + T[:3, 3]
        right_points = (left_points - [STEREO.baseline, 0.0, 0.0]) @ self._turn.T
        left, right = c.project(left_points), c.project(right_points)
        inside = [(p > 5.0).all(axis=1) & (p < [c.width - 5.0, c.height - 5.0]).all(axis=1) for p in (left, right)]
        near = np.flatnonzero(inside[0] & inside[1] & (left_points[:, 2] < 8.0))
        seen = rng.choice(near, min(250, len(near)), replace=False)
        n = len(seen)
        # A keypoint is found off its point; its partner is found for that place.
        off = PIXEL * rng.standard_normal((n, 2))
        difference = left[seen] - right[seen]
        return StereoView(
            STEREO,
            self._looks[seen],
            left[seen] + off,
            difference[:, 0] + DISPARITY * rng.standard_normal(n),
            np.full(n, DISPARITY),
            -difference[:, 1] + ROW * rng.standard_normal(n),
            np.full(n, ROW),
            np.full(n, PIXEL),
        )


def learnt(turn: np.ndarray, seed: int, frames: int = 25, **options) -> StereoSelfCalibration:
    calibration = StereoSelfCalibration(SelfCalibrationConfig(row_floor=0.01, **options))
    for k, view in enumerate(Walk(turn, seed).views(frames)):
        if k == 0:
            calibration.acquire(view)
        calibration.learn(view)
    return calibration


def linear_error(turn: np.ndarray) -> np.ndarray:
    """The parameters that a rotation of the right camera is, to first order."""
    x, y, z = turn
    return np.array([dict(cx=y, cy=-x, yaw=y, pitch=-x, roll=z).get(name, 0.0) for name in NAMES])


def test_a_turned_camera_is_recovered_within_its_claimed_sigma():
    turn = TURN / 3.0  # a degree and more is beyond the linear model's last hundredth of a pixel
    truth, nees = linear_error(turn), []
    for seed in range(8):
        calibration = learnt(turn, seed)
        assert calibration.corrects
        assert calibration.corrects_rows
        difference = calibration.error.parameters - truth
        nees.append(difference @ np.linalg.solve(calibration.error.covariance, difference) / len(NAMES))
    assert 0.4 < np.mean(nees) < 2.0


def test_the_field_is_corrected_where_it_matters():
    calibration, truth = learnt(TURN, 3), RectificationError(STEREO.camera, linear_error(TURN), np.eye(len(NAMES)))
    assert truth.column_rms() > 2.0
    assert truth.row_rms() > 1.0
    pixels = np.random.default_rng(1).uniform([20, 20], [620, 460], (200, 2))
    left_over = calibration.columns(pixels)[0] - truth.columns(pixels)
    assert np.sqrt(np.mean(left_over**2)) < 0.05 * truth.column_rms()
    assert np.abs(left_over / calibration.columns(pixels)[1]).max() < 5.0
    np.testing.assert_allclose(calibration.rows(pixels, np.zeros(200)), truth.rows(pixels, np.zeros(200)), atol=0.1)


def test_a_perfect_pair_is_left_alone():
    for seed in range(8):
        calibration = learnt(np.zeros(3), seed)
        pixels = np.full((3, 2), 100.0)
        assert not np.any(calibration.columns(pixels))
        assert not np.any(calibration.rows(pixels, np.zeros(3)))


def test_a_calibration_that_says_how_it_errs_is_corrected_by_as_much_as_the_views_say():
    """Turns too small for the evidence to be beyond doubt.

    They shift the image by 0.08 px, which is one of the three directions in which 0.14 px are claimed.
    """
    pixels = np.random.default_rng(1).uniform([20, 20], [620, 460], (200, 2))
    before, after, claimed = [], [], []
    for seed in range(8):
        turn = 2e-4 * np.random.default_rng(seed).standard_normal(3)
        truth = RectificationError(STEREO.camera, linear_error(turn), np.eye(len(NAMES)))
        calibration = learnt(turn, seed, sigma_disparity=0.14)
        assert calibration.corrects
        assert "along them" not in calibration.advice()
        field, sigma = calibration.columns(pixels)
        before.append(np.mean(truth.columns(pixels) ** 2))
        after.append(np.mean((field - truth.columns(pixels)) ** 2))
        claimed.append(np.mean(sigma**2))
    assert np.mean(after) < 0.5 * np.mean(before)
    assert 0.3 < np.mean(after) / np.mean(claimed) < 2.0


def test_the_evidence_of_a_camera_that_stands_still_counts_once():
    calibration = StereoSelfCalibration()
    view = Walk(TURN, 0).views(1)[0]
    calibration.acquire(view)
    for _ in range(20):
        calibration.learn(view)
    assert not calibration.corrects
    assert calibration.error.column_sigma_rms() > 1.0


@pytest.mark.parametrize(("turn", "looks"), [(np.zeros(3), range(10, 14)), (TURN, [23])])
def test_only_a_calibration_that_needs_no_correction_is_learnt_from_now_and_then(monkeypatch, turn, looks):
    monkeypatch.setattr("stereo_frontend.stereo.self_calibration._SETTLED", 5)
    looked, compare = [], "stereo_frontend.stereo.self_calibration.match_views"
    monkeypatch.setattr(compare, lambda *views: looked.append(len(views)) or match_views(*views))
    calibration = learnt(turn, 0, frames=24)
    assert calibration.corrects == bool(turn.any())
    assert len(looked) in looks


def test_off_is_off():
    calibration = learnt(TURN, 0, mode="off")
    assert calibration.error is None or not calibration.corrects
    assert Frontend(from_mapping(FrontendConfig, {"self_calibration.mode": "off"})).self_calibration.knows(
        STEREO.camera
    )


def test_matching_of_two_moments_ignores_what_looks_alike():
    view = Walk(np.zeros(3), 0).views(1)[0]
    rows, columns = match_views(view, view, 0.9, 0.8)
    np.testing.assert_array_equal(rows, columns)
    assert len(rows) == len(view)
    looks = view.descriptors + 0.02 * np.random.default_rng(2).standard_normal(view.descriptors.shape)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    changed = replace(view, descriptors=looks.astype(np.float32))
    twice = changed.select(np.r_[np.arange(len(view)), np.arange(10)])
    rows, _ = match_views(view, twice, 0.7, 0.8)
    assert not set(range(10)) & set(rows)
    assert len(rows) > 0.9 * (len(view) - 10)


@pytest.mark.parametrize("row", [-3.2, 3.2])
def test_matches_beyond_the_epipolar_band_are_found_and_measured(stereo_pair, row):
    pair = stereo_pair(12.3, row=row)
    frontend = Frontend(from_mapping(FrontendConfig, {"features.target": 300}))
    features = frontend.process(pair)
    straight = Frontend(from_mapping(FrontendConfig, {"features.target": 300})).process(stereo_pair(12.3))
    assert len(features) > 0.85 * len(straight)
    assert frontend.self_calibration.error.row_rms() == pytest.approx(abs(row), abs=0.1)
    disparity = pair.stereo.camera.fx * pair.stereo.baseline / features.depth
    assert abs(np.median(disparity) - 12.3) < 0.03
    blind = Frontend(from_mapping(FrontendConfig, {"features.target": 300, "self_calibration.mode": "off"}))
    assert len(blind.process(pair)) < 0.5 * len(straight)


def test_another_camera_begins_anew(stereo_pair):
    frontend = Frontend(from_mapping(FrontendConfig, {"features.target": 300}))
    pair = stereo_pair(12.3, row=3.2)
    frontend.process(pair)
    other = StereoCamera(Camera(320, 240, 210.0, 210.0, 160.0, 120.0), pair.stereo.baseline)
    frontend.process(StereoImages(pair.stamp_ns + 1, pair.left, pair.right, other))
    assert frontend.self_calibration.error.camera == other.camera


def test_a_corrected_camera_info_takes_the_error_out():
    raw = Camera(640, 480, 470.0, 471.0, 322.0, 238.0, "plumb_bob", (-0.28, 0.07, 0.0004, -0.0003, 0.0))
    P = np.hstack([STEREO.camera.K, [[-400.0 * 0.12], [0.0], [0.0]]])
    info = CameraInfo(raw, so3_exp(np.array([0.004, -0.006, 0.005])), P)
    error = RectificationError(STEREO.camera, linear_error(TURN / 3.0), np.eye(len(NAMES)))
    corrected, left_over = corrected_right(info, error)
    assert left_over < 0.02
    np.testing.assert_array_equal(corrected.P, info.P)
    turned = corrected.R @ info.R.T
    assert np.linalg.norm(so3_log(turned)) == pytest.approx(np.linalg.norm(TURN / 3.0), rel=0.6)
    pixels = np.array([[100.0, 80.0], [320.0, 240.0], [600.0, 400.0]])
    before, after = (rectification_map(i, STEREO.camera) for i in (info, corrected))
    shifts = np.column_stack([error.columns(pixels), error.rows(pixels, np.zeros(3))])
    for (u, v), shift in zip(pixels.astype(int), shifts, strict=True):
        moved = STEREO.camera.unproject(np.array([[u, v]]) + shift, np.ones(1)) @ info.R
        np.testing.assert_allclose(after[v, u], raw.project(moved)[0], atol=0.03)
        assert np.abs(after[v, u] - before[v, u]).max() > 0.05
