# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of a ToF camera beside an exact stereo pair, in rooms of a few planes of unequal reflectance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.config import from_mapping
from slam_core.types import DepthImage
from stereo_frontend.depth.range_error import KNOTS, RangeFields, dimension, prior_covariance, ray_length
from stereo_frontend.depth.range_self_calibration import (
    RangeDifferences,
    RangeSelfCalibration,
    RangeSelfCalibrationConfig,
    _shared_by_neighbours,
)

CAMERA = Camera(96, 96, 130.0, 130.0, 47.5, 47.5)
STEREO = StereoCamera(Camera(640, 480, 283.0, 283.0, 320.0, 240.0), 0.12)
DISPARITY, NOISE = 0.1, 0.004
AMBIGUITY = 7.5


class Rig:
    """Views of both cameras; light that is scattered in the ToF camera's lens is ``scatter`` of that around a pixel."""

    def __init__(self, seed: int, *, scatter: float = 0.0, wiggling: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        self._scatter, self._wiggling = scatter, wiggling

    def view(self) -> tuple[DepthImage, np.ndarray]:
        """A depth image as it is measured, and the true depths."""
        rng = self._rng
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width] / 96.0
        slope, near = rng.uniform(-0.3, 0.3, 2), rng.uniform(1.5, 2.5)
        true = near + slope[0] * u + slope[1] * v + np.where(u > rng.uniform(0.3, 0.7), rng.uniform(0.3, 1.5), 0.0)
        patches = rng.uniform(0.3, 1.0, (8, 8))[(8 * v).astype(int), (8 * u).astype(int)]
        distance = true * ray_length(CAMERA)
        phasor = 1000.0 * patches / distance**2 * np.exp(2j * np.pi * distance / AMBIGUITY)
        phasor += self._scatter * phasor.mean() * np.exp(2j * np.pi * 0.4 / AMBIGUITY)
        measured = np.mod(np.angle(phasor) / (2 * np.pi), 1.0) * AMBIGUITY
        measured += self._wiggling * np.sin(8 * np.pi * measured / AMBIGUITY) + NOISE * rng.standard_normal(true.shape)
        sigma = np.full(true.shape, NOISE, np.float32)
        depth = (measured / ray_length(CAMERA)).astype(np.float32)
        return DepthImage(0, depth, sigma, CAMERA, np.abs(phasor).astype(np.float32)), true

    def differences(self, image: DepthImage, true: np.ndarray) -> RangeDifferences:
        """What 120 features of both cameras show."""
        uv = self._rng.integers(3, 93, (120, 2)).astype(float)
        u, v = uv.astype(int).T
        disparity = STEREO.camera.fx * STEREO.baseline / true[v, u]
        seen = disparity + DISPARITY * self._rng.standard_normal(len(uv))
        stereo = STEREO.depth_from_disparity(seen)
        depths = np.column_stack([image.depth[v, u], stereo])
        sigmas = np.column_stack([image.sigma[v, u], stereo**2 / (STEREO.camera.fx * STEREO.baseline) * DISPARITY])
        return RangeDifferences.between(uv, depths, sigmas, ray_length(CAMERA)[v, u])


def run(rig: Rig, views: int, calibration: RangeSelfCalibration | None = None) -> RangeSelfCalibration:
    calibration = calibration or RangeSelfCalibration()
    for _ in range(views):
        image, true = rig.view()
        fields = calibration.look(image)
        calibration.learn(image, fields, rig.differences(calibration.corrected(image, fields), true))
    return calibration


def errors(calibration: RangeSelfCalibration, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Range errors after correction at some pixels of new views, and their claimed standard deviation, m."""
    left, claimed = [], []
    for _ in range(10):
        image, true = rig.view()
        fields = calibration.look(image)
        uv = np.random.default_rng(1).integers(3, 93, (50, 2)).astype(float)
        u, v = uv.astype(int).T
        left.append(((calibration.corrected(image, fields).depth - true) * ray_length(CAMERA))[v, u])
        claimed.append(calibration.sigma(fields, uv))
    return np.concatenate(left), np.concatenate(claimed)


def test_scattered_light_and_wiggling_are_learnt_and_corrected() -> None:
    rig = Rig(1, scatter=0.1, wiggling=0.01)
    before, _ = errors(RangeSelfCalibration(), rig)
    calibration = run(rig, 60)
    after, claimed = errors(calibration, rig)
    assert calibration.corrects
    assert np.sqrt(np.mean(before**2)) > 0.03
    assert np.sqrt(np.mean(after**2)) < 0.25 * np.sqrt(np.mean(before**2))
    assert np.mean(after**2 / (claimed**2 + NOISE**2)) < 1.5
    assert "off by" in calibration.advice()
    assert calibration.figures()["corrected"] == "yes"


def test_an_exact_camera_is_left_alone() -> None:
    for seed in range(5):
        calibration = run(Rig(seed), 40)
        image, _ = Rig(seed).view()
        fields = calibration.look(image)
        assert not calibration.corrects
        assert calibration.corrected(image, fields) is image
        np.testing.assert_array_equal(calibration.sigma(fields, np.array([[20.0, 20.0]])), 0.0)
        assert calibration.advice() == ""


def test_a_camera_without_amplitude_is_corrected_by_its_range() -> None:
    class Blind(Rig):
        def view(self) -> tuple[DepthImage, np.ndarray]:
            image, true = super().view()
            return replace(image, depth=image.depth + np.float32(0.04), amplitude=None), true

    rig = Blind(3)
    calibration = run(rig, 30)
    after, _ = errors(calibration, rig)
    assert abs(np.mean(after)) < 0.006


def test_the_same_view_counts_once_and_off_means_off() -> None:
    rig = Rig(4, scatter=0.1)
    image, true = rig.view()
    calibration = RangeSelfCalibration()
    for _ in range(10):
        calibration.learn(image, calibration.look(image), rig.differences(image, true))
    assert not calibration.corrects
    off = run(rig, 10, RangeSelfCalibration(from_mapping(RangeSelfCalibrationConfig, {"mode": "off"})))
    assert off.figures() == {}
    assert not off.corrects


def test_reset_forgets() -> None:
    calibration = run(Rig(5, scatter=0.1), 20)
    assert calibration.corrects
    calibration.reset()
    assert not calibration.corrects
    assert calibration.figures() == {}


@pytest.mark.parametrize("amplitude", [True, False])
def test_the_error_of_the_image_is_the_rows_times_the_parameters(amplitude: bool) -> None:
    image, _ = Rig(6).view()
    image = image if amplitude else replace(image, amplitude=None)
    size = dimension(amplitude)
    theta = np.random.default_rng(0).standard_normal(size)
    fields = RangeFields.of(image, 200.0)
    uv = np.array([[3.0, 5.0], [40.0, 80.0], [90.0, 12.0]])
    u, v = uv.astype(int).T
    np.testing.assert_allclose(fields.rows(uv) @ theta, fields.error(theta)[v, u], rtol=1e-5)
    np.testing.assert_allclose(fields.rows(uv)[:, : len(KNOTS)].sum(axis=1), 1.0, rtol=1e-6)
    assert np.linalg.eigvalsh(prior_covariance(size)).min() > 0.0


def test_surroundings_of_an_even_wall_are_like_itself() -> None:
    shape = (CAMERA.height, CAMERA.width)
    depth = (2.0 / ray_length(CAMERA)).astype(np.float32)
    image = DepthImage(0, depth, np.full(shape, 0.01, np.float32), CAMERA, np.full(shape, 80.0, np.float32))
    fields = RangeFields.of(image, 80.0)
    weakness, share, ahead = fields.terms()
    np.testing.assert_allclose(share, 1.0, atol=1e-5)
    np.testing.assert_allclose(ahead, 0.0, atol=1e-5)
    np.testing.assert_allclose(weakness, 1.0, atol=1e-6)


def test_the_kernel_sums_what_neighbours_share() -> None:
    rng = np.random.default_rng(0)
    uv, residual, scale, certainty = rng.uniform(0, 50, (30, 2)), *rng.uniform(0.5, 2.0, (3, 30))
    near = np.triu(np.linalg.norm(uv[:, None] - uv, axis=2) < 10.0, 1)
    share = near * np.outer(certainty, certainty)
    expected = (share * np.outer(residual, residual)).sum(), (share * np.outer(scale, scale)).sum()
    np.testing.assert_allclose(_shared_by_neighbours(uv, residual, scale, certainty, 10.0), expected)
