# SPDX-License-Identifier: Apache-2.0
"""The distortion of depth is taken out of it, and its uncertainty goes into sigma."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.config import from_mapping
from tof_driver.depth import DepthConfig, DepthProcessor

CAMERA = Camera(160, 120, 145.0, 145.0, 79.5, 59.5)
COLUMNS, ROWS = 0.05, -0.03


def config(measurement: str, **distortion: float) -> DepthConfig:
    named = {f"depth_distortion.{name}": value for name, value in distortion.items()}
    return from_mapping(DepthConfig, {"measurement": measurement} | named)


@pytest.mark.parametrize("measurement", ["depth", "range"])
def test_a_bent_wall_becomes_flat(measurement: str) -> None:
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    along_ray = np.sqrt(1.0 + x**2 + y**2) if measurement == "range" else 1.0
    factor = 1.0 + COLUMNS * (x**2 - np.mean(x**2)) + ROWS * (y**2 - np.mean(y**2))
    image = (2.0 * along_ray / factor).astype(np.float32)
    corrected = DepthProcessor(config(measurement, columns=COLUMNS, rows=ROWS), CAMERA).process(0, image)
    np.testing.assert_allclose(corrected.depth, 2.0, atol=1e-5)
    assert np.ptp(DepthProcessor(config(measurement), CAMERA).process(0, image).depth) > 0.01


def test_sigma_holds_the_uncertainty_of_the_correction() -> None:
    image = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    plain = DepthProcessor(config("depth"), CAMERA).process(0, image)
    unsure = DepthProcessor(config("depth", sigma_columns=0.02), CAMERA).process(0, image)
    np.testing.assert_array_equal(unsure.depth, plain.depth)
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    added = np.sqrt(unsure.sigma[60].astype(float) ** 2 - plain.sigma[60].astype(float) ** 2)
    np.testing.assert_allclose(added, 2.0 * 0.02 * np.abs(x**2 - np.mean(x**2)), atol=2e-4)
