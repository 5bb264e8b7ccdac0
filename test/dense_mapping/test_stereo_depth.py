# SPDX-License-Identifier: Apache-2.0
"""Dense stereo depth against the truth of the simulator: honest sigma, no guessed walls."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dense_mapping.stereo_depth import StereoDepthConfig, stereo_depth
from dense_mapping.stereo_kernels import StepNoise, drop_occluded, refine
from slam_core.camera import Camera, StereoCamera
from slam_core.types import StereoImages
from slam_simulation.scenario import Scenario
from slam_simulation.simulator import Simulator

STEREO = StereoCamera(Camera(320, 240, 200.0, 200.0, 159.5, 119.5), 0.1)


def shifted_texture(rng: np.random.Generator, disparity: float, contrast: float = 1.0) -> StereoImages:
    """A wall with texture, seen head-on at one disparity."""
    u = np.arange(STEREO.camera.width + 64.0)
    rows = []
    for _ in range(STEREO.camera.height // 8):
        waves = [rng.uniform(10, 25) * np.sin(u * f + rng.uniform(0, 6)) for f in rng.uniform(0.1, 0.9, 6)]
        rows += [np.sum(waves, axis=0)] * 8
    texture = np.array(rows)
    columns = np.arange(STEREO.camera.width)
    left, right = (np.stack([np.interp(columns + shift, u, row) for row in texture]) for shift in (0.0, disparity))
    noisy = [
        np.clip(128 + contrast * image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
        for image in (left, right)
    ]
    return StereoImages(0, noisy[0], noisy[1], STEREO)


@pytest.mark.parametrize("max_pixels", [320 * 240, 320 * 240 - 1])
@pytest.mark.parametrize("disparity", [6.0, 9.37, 14.5])
def test_a_textured_wall_is_measured_to_a_fraction_of_a_pixel(rng, disparity, max_pixels):
    """Also where the images are halved for matching."""
    image = stereo_depth(shifted_texture(rng, disparity), StereoDepthConfig(max_pixels=max_pixels))
    known = np.isfinite(image.depth)
    found = 200.0 * 0.1 / image.depth[known]
    assert known[20:-20, 40:-20].mean() > 0.9
    assert abs(np.median(found) - disparity) < 0.05
    assert np.percentile(np.abs(found - disparity), 95) < 0.3


def test_a_wall_with_hardly_any_texture_is_kept_with_a_larger_sigma(rng):
    """The matcher's own disparity holds where a step by the picture would be wild."""
    faint, clear = (stereo_depth(shifted_texture(rng, 9.37, contrast), StereoDepthConfig()) for contrast in (0.07, 1.0))
    known = np.isfinite(faint.depth)
    error = 200.0 * 0.1 / faint.depth[known] - 9.37
    assert known[20:-20, 40:-20].mean() > 0.85
    assert np.percentile(np.abs(error), 95) < 0.7
    assert np.nanmedian(faint.sigma) > 2.0 * np.nanmedian(clear.sigma)


def test_a_wall_without_texture_is_not_guessed(rng):
    grey = [rng.normal(120, 1.5, (240, 320)).astype(np.uint8) for _ in range(2)]
    image = stereo_depth(StereoImages(0, grey[0], grey[1], STEREO), StereoDepthConfig())
    assert np.isfinite(image.depth).mean() < 0.02


def test_errors_are_those_that_sigma_claims():
    simulator = Simulator(Scenario.load("small_room"), threads=1, truth=True, rectified=True)
    errors, sigmas = [], []
    for frame in simulator.run(frames=60, every=20):
        images = StereoImages(frame.stamp_ns, frame.left, frame.right, simulator.stereo.stereo)
        image = stereo_depth(images, StereoDepthConfig())
        true_depth = frame.truth.depth[::2, ::2]
        near = np.isfinite(image.depth) & (image.depth < 3.0) & (true_depth > 0)
        errors.append((image.depth - true_depth)[near])
        sigmas.append(image.sigma[near])
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert len(error) > 12_500
    assert np.median(np.abs(error)) < 0.03
    assert np.median(np.abs(error)) / 0.6745 < 1.3 * np.median(sigma), "sigma must not be too small"
    assert np.median(np.abs(error)) / 0.6745 > 0.4 * np.median(sigma), "nor too large"
    assert np.mean(np.abs(error) > 5.0 * sigma) < 0.025


NOISE = StepNoise(image=2.0, matched=0.5, scale=2.0, floor=0.05, largest_step=0.6, least_known=0.9)


def refined_by_numpy(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(disparity)
    place = np.clip(np.arange(disparity.shape[1]) - np.where(known, disparity, 0.0), 0, disparity.shape[1] - 1)
    warped = np.array([np.interp(u, np.arange(len(row)), row) for u, row in zip(place, right, strict=True)])
    slope = np.array([[-0.25, 0.0, 0.25]])
    g, r = cv2.filter2D(left + warped, cv2.CV_64F, slope), warped - left

    def total(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values * known, cv2.CV_64F, (15, 15), normalize=False, borderType=cv2.BORDER_REPLICATE)

    count = np.maximum(total(np.ones_like(g)), 1.0)
    offset, mean = total(r) / count, total(g) / count
    energy = np.maximum(total(g * g) - count * (mean**2 + 1.0), 1e-3)
    spread = 4.0 * np.maximum(total(r * r) / count - offset**2, 8.0)
    information = energy + spread / 0.25
    step = (total(g * r) - count * mean * offset) / information
    kept = known & (count >= 0.9 * 225) & (np.abs(step) < 0.6) & (disparity + step > 0.5)
    sigma = np.hypot(np.sqrt(spread / information), 0.05)
    return np.where(kept, disparity + step, np.nan), np.where(kept, sigma, np.nan)


@pytest.mark.parametrize("spacing", [1, 2])
def test_the_compiled_step_is_that_of_numpy(rng, spacing):
    pair = shifted_texture(rng, 9.37)
    disparity = (9.37 + rng.normal(0, 0.2, pair.left.shape)).astype(np.float32)
    disparity[50:60, 100:130] = np.nan
    expected = refined_by_numpy(pair.left.astype(float), pair.right.astype(float), disparity)
    found = refine(pair.left, pair.right, disparity, 15, spacing, NOISE)
    for values, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(values, wanted[::spacing, ::spacing], atol=2e-4)
    assert 0.5 < np.isfinite(found[0]).mean() < 0.99


def test_a_surface_nearer_than_all_else_is_searched_for(rng):
    """The range of disparities is that of the picture, up to the smallest depth."""
    far, near = (shifted_texture(rng, disparity) for disparity in (6.0, 37.0))
    left, right = far.left.copy(), far.right.copy()
    left[60:180, 160:260], right[60:180, 123:223] = near.left[60:180, 160:260], near.right[60:180, 123:223]
    image = stereo_depth(StereoImages(0, left, right, STEREO), StereoDepthConfig(min_depth=0.5))
    assert abs(np.nanmedian(image.depth[90:150, 190:230]) - 20.0 / 37.0) < 0.01
    assert np.isfinite(image.depth[90:150, 190:230]).mean() > 0.9


def occluded_by_numpy(disparity: np.ndarray, most: float) -> np.ndarray:
    kept = np.full_like(disparity, np.nan)
    for row in range(len(disparity)):
        known = np.nonzero(np.isfinite(disparity[row]))[0]
        d = disparity[row, known]
        partner = np.rint(known - d)
        nearest = np.array([d[partner == p].max() for p in partner])
        seen = (partner >= 0) & (d >= nearest - most)
        kept[row, known[seen]] = d[seen]
    return kept


def test_the_compiled_drop_of_what_is_occluded_is_that_of_numpy(rng):
    disparity = rng.uniform(0.5, 30.0, (12, 80)).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.2] = np.nan
    expected = occluded_by_numpy(disparity, 1.0)
    drop_occluded(disparity, 1.0, np.empty(80, np.float32))
    np.testing.assert_array_equal(disparity, expected)
    assert 0.2 < np.isfinite(disparity).mean() < 0.7


def test_what_stands_behind_a_post_is_left_out():
    """Left of a post the right camera sees the post where the left one sees the wall."""
    disparity = np.full((4, 60), 5.0, np.float32)
    disparity[:, 30:40] = 15.0
    drop_occluded(disparity, 1.0, np.empty(60, np.float32))
    expected = [*range(5), *range(20, 30)]
    assert np.nonzero(np.isnan(disparity[0]))[0].tolist() == expected
