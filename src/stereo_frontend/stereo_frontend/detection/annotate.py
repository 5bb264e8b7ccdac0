# SPDX-License-Identifier: Apache-2.0
"""A picture of what the front end sees.

Features over the image, coloured by depth, shaped by where the depth came from.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from slam_core.types import ByteArray, Features, FeatureSource

_NEAR, _FAR = 0.5, 8.0
"""Depths (m) at the ends of the colour scale, on a scale of inverse depth."""


def annotated_image(image: ByteArray, features: Features) -> ByteArray:
    """Colour picture (height, width, 3), BGR, of an image, grey or red first, and its features.

    Stereo circles, ToF squares, fused both; dots of those that only a direction was measured of.
    """
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
    colours = _depth_colours(features.depth)
    is_dot = features.source == FeatureSource.PREDICTED
    circles = ((features.source != FeatureSource.TOF) & ~is_dot).tolist()
    squares = ((features.source != FeatureSource.STEREO) & ~is_dot).tolist()
    places = np.round(features.uv).astype(int).tolist()
    for (u, v), circle, square, colour in zip(places, circles, squares, colours, strict=True):
        if circle:
            cv2.circle(picture, (u, v), 4, colour, 1, cv2.LINE_AA)
        if square:
            cv2.rectangle(picture, (u - 4, v - 4), (u + 4, v + 4), colour, 1)
        if not (circle or square):
            cv2.circle(picture, (u, v), 2, colour, cv2.FILLED, cv2.LINE_AA)
    cv2.putText(picture, f"{len(features)} features", (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
    return np.asarray(picture)


def _depth_colours(depth: np.ndarray) -> list[tuple[int, int, int]]:
    share = np.clip((1.0 / np.maximum(depth, 1e-3) - 1.0 / _FAR) / (1.0 / _NEAR - 1.0 / _FAR), 0.0, 1.0)
    colours = _colours()
    return [colours[level] for level in (255 * share).astype(np.uint8).tolist()]


@cache
def _colours() -> list[tuple[int, int, int]]:
    """The 256 colours of the scale, blue first; OpenCV makes the table anew for every picture."""
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_JET)[:, 0]
    return [(b, g, r) for b, g, r in table.tolist()]
