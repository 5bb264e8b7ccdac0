# SPDX-License-Identifier: Apache-2.0
"""The building's plan with the map's walls and paths, and the pairs of points, drawn on it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import ByteArray
from slam_viewer.anchor.building_plan import BuildingPlan
from slam_viewer.anchor.map_from_above import PATH_COLOURS

_LONG_SIDE = 1400
_PALER = 0.55
_MOST_BEYOND = 1.0
"""Largest reach of the picture beyond the plan where the map goes there, as a share of the plan's size."""
_WALL, _GOOD, _BAD, _TEXT = (60, 60, 230), (30, 140, 30), (0, 110, 255), (40, 40, 40)
_BEYOND = (225, 225, 225)
_SHIFT = 4

Pixels = npt.NDArray[np.int32]
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Overlay:
    """A picture of the plan that all of ``points`` (n, 2) m of the building lie on, if they are not far beyond it."""

    def __init__(self, plan: BuildingPlan, points: FloatArray) -> None:
        self._plan = plan
        size = np.array(plan.size, dtype=np.float64)
        reach = np.concatenate([plan.pixels(points), [[0.0, 0.0]], [size]])
        low = np.floor(np.maximum(reach.min(axis=0), -_MOST_BEYOND * size))
        high = np.ceil(np.minimum(reach.max(axis=0), (1.0 + _MOST_BEYOND) * size))
        self._low = low
        self._scale = max(1.0, float(np.ceil(_LONG_SIDE / (high - low).max())))
        width, height = ((high - low) * self._scale).astype(int)
        self.image: ByteArray = np.full((height, width, 3), _BEYOND, dtype=np.uint8)
        left, top = (-low * self._scale).astype(int)
        shown = cv2.resize(plan.image, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_NEAREST)
        paler = np.rint(255.0 - _PALER * (255.0 - shown)).astype(np.uint8)
        self.image[top : top + shown.shape[0], left : left + shown.shape[1]] = paler

    def draw_walls(self, walls: FloatArray, edge: float) -> None:
        """Squares (n, 2) m of the given edge, half transparent."""
        over = self.image.copy()
        radius = max(1, round(0.5 * edge / self._metres_a_pixel()))
        for u, v in self._at(walls) >> _SHIFT:
            cv2.rectangle(over, (int(u) - radius, int(v) - radius), (int(u) + radius, int(v) + radius), _WALL, -1)
        self.image[:] = cv2.addWeighted(over, 0.6, self.image, 0.4, 0.0)

    def draw_paths(self, paths: list[FloatArray]) -> None:
        """A line of each agent's places (n, 2) m, a disc at its start."""
        for k, path in enumerate(paths):
            colour, line = PATH_COLOURS[k % len(PATH_COLOURS)], self._at(path)
            cv2.polylines(self.image, [line], False, colour, 3, cv2.LINE_AA, _SHIFT)
            for place in line[:1]:
                cv2.circle(self.image, self._pair(place), 6 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)

    def draw_pairs(self, clicked: FloatArray, mapped: FloatArray, is_used: list[bool]) -> None:
        """Rings where the plan was clicked and crosses where the map has the same point (n, 2) m, numbered from 1."""
        for k, (ring, cross) in enumerate(zip(self._at(clicked), self._at(mapped), strict=True)):
            colour = _GOOD if is_used[k] else _BAD
            cv2.line(self.image, self._pair(ring), self._pair(cross), colour, 2, cv2.LINE_AA, _SHIFT)
            cv2.circle(self.image, self._pair(ring), 11 << _SHIFT, colour, 2, cv2.LINE_AA, _SHIFT)
            u, v = (int(x) >> _SHIFT for x in cross)
            cv2.drawMarker(self.image, (u, v), colour, cv2.MARKER_CROSS, 18, 2, cv2.LINE_AA)
            self._write(str(k + 1) if is_used[k] else f"{k + 1} left out", (u + 15, v - 12), colour)

    def draw_scale_bar(self) -> None:
        """A bar of a round length, at the lower left."""
        height, width = self.image.shape[:2]
        length = next((m for m in (50, 20, 10, 5, 2, 1) if m / self._metres_a_pixel() < 0.3 * width), 0.5)
        left, bottom, right = 25, height - 25, 25 + round(length / self._metres_a_pixel())
        cv2.rectangle(self.image, (left - 12, bottom - 42), (right + 12, bottom + 14), (255, 255, 255), -1)
        cv2.line(self.image, (left, bottom), (right, bottom), _TEXT, 4)
        self._write(f"{length:g} m", (left, bottom - 14), _TEXT)

    def _write(self, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
        size = max(self.image.shape) / 1800.0
        cv2.putText(self.image, text, at, _FONT, size, (255, 255, 255), 6, cv2.LINE_AA)
        cv2.putText(self.image, text, at, _FONT, size, colour, 2, cv2.LINE_AA)

    def _metres_a_pixel(self) -> float:
        assert self._plan.resolution is not None
        return self._plan.resolution / self._scale

    def _at(self, points: FloatArray) -> Pixels:
        """Pixels (n, 2) of the picture, times 2 to the power of ``_SHIFT``; what lies far off stays far off."""
        pixels = (self._plan.pixels(points) - self._low) * self._scale - 0.5
        return np.asarray(np.rint(np.clip(pixels, -30000.0, 30000.0) * (1 << _SHIFT)), dtype=np.int32)

    @staticmethod
    def _pair(place: Pixels) -> tuple[int, int]:
        return int(place[0]), int(place[1])
