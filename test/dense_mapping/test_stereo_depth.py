# SPDX-License-Identifier: Apache-2.0
"""Dense stereo depth against the truth of the simulator: honest sigma, no guessed walls."""

from __future__ import annotations

import numpy as np
import pytest

from dense_mapping.stereo_depth import StereoDepthConfig, stereo_depth
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
        near = np.isfinite(image.depth) & (image.depth < 3.0) & (frame.truth.depth > 0)
        errors.append((image.depth - frame.truth.depth)[near])
        sigmas.append(image.sigma[near])
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert len(error) > 50_000
    assert np.median(np.abs(error)) < 0.03
    assert np.median(np.abs(error)) / 0.6745 < 1.3 * np.median(sigma), "sigma must not be too small"
    assert np.median(np.abs(error)) / 0.6745 > 0.4 * np.median(sigma), "nor too large"
    assert np.mean(np.abs(error) > 5.0 * sigma) < 0.025
