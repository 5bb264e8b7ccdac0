# SPDX-License-Identifier: Apache-2.0
"""The floor plan of a building: an image, and where its pixels lie in the building's frame, as map_server has it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_core.storage.files import read_bytes, read_yaml
from slam_core.types import ByteArray

_MOST_PIXELS = 100_000_000


@dataclass(frozen=True, eq=False)
class BuildingPlan:
    """``image`` (rows, columns, 3) BGR; ``resolution`` m/px or None where it is not known.

    ``origin``: x, y (m) and yaw (rad) of the lower left corner in the building's frame. A pixel (u, v) is measured from
    the upper left corner to the right and down; the middle of the first pixel is (0.5, 0.5).
    """

    path: Path
    image: ByteArray
    resolution: float | None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.image.shape[1], self.image.shape[0]

    def with_resolution(self, resolution: float) -> BuildingPlan:
        """Copy with a resolution in m/px."""
        return replace(self, resolution=resolution)

    def from_lower_left(self, pixels: FloatArray) -> FloatArray:
        """Pixels (n, 2) from the lower left corner, the second one up."""
        return np.column_stack([pixels[:, 0], self.size[1] - pixels[:, 1]])

    def points(self, pixels: FloatArray) -> FloatArray:
        """Places (n, 2) m in the building's frame of pixels (n, 2)."""
        return self._scale() * self.from_lower_left(pixels) @ self._turn().T + self.origin[:2]

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of places (n, 2) m in the building's frame."""
        corner = (points - self.origin[:2]) @ self._turn() / self._scale()
        return np.column_stack([corner[:, 0], self.size[1] - corner[:, 1]])

    def _turn(self) -> FloatArray:
        c, s = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.array([[c, -s], [s, c]])

    def _scale(self) -> float:
        if self.resolution is None:
            raise ValueError("the plan's resolution is not known")
        return self.resolution


def read_building_plan(path: Path, resolution: float | None = None) -> BuildingPlan:
    """The plan of an image (PNG, PGM, JPG), or of a map_server YAML that names one with resolution and origin.

    Raises
    ------
    ValueError
        If it is neither, or a resolution is given twice.
    """
    if path.suffix.lower() not in (".yaml", ".yml"):
        return BuildingPlan(path, _read_image(path), None if resolution is None else _checked(resolution))
    if resolution is not None:
        raise ValueError(f"{path} has a resolution of its own: leave --resolution out")
    content = read_yaml(path)
    try:
        if not isinstance(content, Mapping):
            raise ValueError("it is not a mapping")
        own = _checked(float(content["resolution"]))
        x, y, yaw = (float(v) for v in content.get("origin", (0.0, 0.0, 0.0)))
        if not all(map(math.isfinite, (x, y, yaw))):
            raise ValueError("the origin must be finite numbers")
        image = path.parent / str(content["image"])
    except (KeyError, TypeError, ValueError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is no map of map_server: {missing}") from error
    return BuildingPlan(path, _read_image(image), own, (x, y, yaw))


def _checked(resolution: float) -> float:
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise ValueError(f"the resolution must be positive, in metres for a pixel, got {resolution}")
    return resolution


def _read_image(path: Path) -> ByteArray:
    """BGR, white where it is transparent; turned as its EXIF says, as browsers show it."""
    data = np.frombuffer(read_bytes(path), dtype=np.uint8)
    try:
        raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if raw is not None else None
    except cv2.error:
        raw = image = None
    if raw is None or image is None:
        raise ValueError(f"{path} is no image that can be read: give a PNG, PGM or JPG of the floor plan")
    if image.shape[0] * image.shape[1] > _MOST_PIXELS:
        raise ValueError(
            f"{path} has {image.shape[1]} x {image.shape[0]} pixels, more than {_MOST_PIXELS}: scale it down"
        )
    if raw.ndim == 3 and raw.shape[2] == 4:
        opaque = raw[:, :, 3:].astype(np.float64) / (255.0 if raw.dtype == np.uint8 else 65535.0)
        image = np.rint(image * opaque + 255.0 * (1.0 - opaque)).astype(np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint8)
