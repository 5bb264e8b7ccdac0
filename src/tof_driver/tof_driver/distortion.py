# SPDX-License-Identifier: Apache-2.0
"""Smooth error of a depth camera over its image: a factor that grows with the squares of column and row.

    true depth = depth (1 + columns (x^2 - mean x^2) + rows (y^2 - mean y^2)),   x, y = ray / z

Such an error bends walls: a flat one looks like a bowl or a dome, which turns with the camera, so that scans measure
turns as too large or too small (structured light: Teichman, Miller and Thrun 2013). The mean over the image is left
alone, as it cannot be told from the scale of the room. ``slam calibrate refine`` finds both numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import Float32Array

_LARGEST = 0.3


@dataclass(frozen=True)
class DepthDistortionConfig(Config):
    """Factor of depth over the image; zeros: the depth is taken as it is."""

    columns: float = parameter(
        0.0, "share by which depth is too short per squared x / z of a ray", minimum=-_LARGEST, maximum=_LARGEST
    )
    rows: float = parameter(0.0, "the same per squared y / z", minimum=-_LARGEST, maximum=_LARGEST)
    sigma_columns: float = parameter(0.0, "standard deviation of columns", minimum=0.0, maximum=_LARGEST)
    sigma_rows: float = parameter(0.0, "standard deviation of rows", minimum=0.0, maximum=_LARGEST)

    @property
    def is_exact(self) -> bool:
        """True if nothing is corrected and nothing is uncertain."""
        return self == DepthDistortionConfig()


class DepthDistortion:
    """Corrections of the pixels of one camera.

    Attributes
    ----------
    factor
        True over measured depth, shape (height, width).
    sigma
        Its standard deviation, same shape.
    """

    def __init__(self, config: DepthDistortionConfig, camera: Camera) -> None:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].reshape(2, -1)
        terms = np.square(camera.normalised_from_pixels(np.column_stack([u, v]).astype(np.float64)))
        terms = np.nan_to_num(terms - np.nanmean(terms, axis=0))
        shape = camera.height, camera.width
        self.factor: Float32Array = _image(1.0 + terms @ [config.columns, config.rows], shape)
        self.sigma: Float32Array = _image(np.hypot(*(terms * [config.sigma_columns, config.sigma_rows]).T), shape)


def _image(values: FloatArray, shape: tuple[int, int]) -> Float32Array:
    return np.asarray(values, np.float32).reshape(shape)
