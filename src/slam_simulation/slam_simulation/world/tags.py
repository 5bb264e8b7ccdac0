# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags on walls: a white card with the black square of a tag of one of OpenCV's dictionaries."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_simulation.world.world import Material, Rectangle

_DICTIONARIES = {"apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11, "aruco_4x4_50": cv2.aruco.DICT_4X4_50}
_TEXELS = 256
_BEFORE_WALL = 0.004
"""Thickness of the card, m."""


@dataclass(frozen=True)
class TagOnWall:
    """A tag: number, middle ``at`` (x, y, z) m, ``yaw`` deg of the way it faces, ``size`` m of its black square."""

    id: int
    at: tuple[float, float, float]
    yaw: float = 0.0
    size: float = 0.16
    dictionary: str = "apriltag_36h11"

    def __post_init__(self) -> None:
        if self.dictionary not in _DICTIONARIES:
            raise ValueError(
                f"tag {self.id}: unknown dictionary '{self.dictionary}', known: {', '.join(_DICTIONARIES)}"
            )
        count = len(_dictionary(self.dictionary).bytesList)
        if not 0 <= self.id < count or not self.size > 0.0 or len(self.at) != 3:
            raise ValueError(f"tag {self.id}: needs an id below {count}, a positive size and at: [x, y, z]")

    @property
    def rotation(self) -> FloatArray:
        """R_world_tag (3, 3): x to the right as one looks at the tag, y up, z out of the wall."""
        yaw = np.radians(self.yaw)
        out = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        return np.column_stack([np.cross(up, out), up, out])

    @property
    def middle(self) -> FloatArray:
        """Middle of the printed side, (3,) m."""
        return np.array(self.at) + _BEFORE_WALL * self.rotation[:, 2]

    def surface(self, room: int) -> Rectangle:
        """The card, with one cell of white around the black square."""
        cells = _cells(self.dictionary)
        side = self.size * cells / (cells - 2)
        right, up = side * self.rotation[:, 0], side * self.rotation[:, 1]
        material = Material(f"tag/{self.dictionary}/{self.id}")
        return Rectangle(self.middle - 0.5 * (right + up), right, up, material, room)


def is_tag(material: str) -> bool:
    """True for the material of a tag's card."""
    return material.startswith("tag/")


def tag_picture(material: str) -> FloatArray:
    """Reflectance of the card of a material ``tag/<dictionary>/<id>``."""
    _, dictionary, number = material.split("/")
    cells = _cells(dictionary)
    square = cv2.aruco.generateImageMarker(_dictionary(dictionary), int(number), (cells - 2) * 32)
    card = np.pad(square, 32, constant_values=255)
    image = cv2.resize(card, (_TEXELS, _TEXELS), interpolation=cv2.INTER_AREA).astype(np.float64)
    return 0.06 + 0.84 * image / 255.0


def _cells(dictionary: str) -> int:
    """Cells along a card: those of the pattern, a black one and a white one on either side."""
    return int(_dictionary(dictionary).markerSize) + 4


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(_DICTIONARIES[name])
