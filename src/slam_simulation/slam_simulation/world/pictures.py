# SPDX-License-Identifier: Apache-2.0
"""Pictures that occur once: posters, book spines, doors, screens, windows, notices. Each is drawn from a seed.

A picture fills a whole surface; its reflectance image has sides that are powers of two, chosen from the surface's
size so that a texel is about 3 mm: finer than a pixel of the cameras at the distances at which they look at walls.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import Float32Array

TEXEL = 0.003
"""Wanted size of a texel, m."""


def draw_picture(kind: str, width: float, height: float, rng: np.random.Generator) -> FloatArray:
    """Reflectance (h, w) in [0, 1] of a picture ``kind`` for a surface of ``width`` x ``height`` m."""
    w, h = (1 << min(max(round(math.log2(side / TEXEL)), 5), 10) for side in (width, height))
    canvas = np.full((h, w), 0.8, np.float32)
    PICTURES[kind](canvas, rng)
    # Print and paint have no edges sharper than this, and no surface is perfectly even.
    grain = cv2.resize(rng.normal(0.0, 0.012, (max(h // 4, 1), max(w // 4, 1))).astype(np.float32), (w, h))
    return np.asarray(np.clip(cv2.GaussianBlur(canvas, (3, 3), 0.6) + grain, 0.02, 0.97), dtype=np.float64)


def _rectangle(canvas: Float32Array, x: float, y: float, w: float, h: float, value: float) -> None:
    """Fill a rectangle given in fractions of the canvas."""
    H, W = canvas.shape
    canvas[max(int(y * H), 0) : int((y + h) * H) + 1, max(int(x * W), 0) : int((x + w) * W) + 1] = value


def _text(
    canvas: Float32Array, box: tuple[float, float, float, float], rng: np.random.Generator, ink: float, size: float
) -> None:
    """Lines of made-up letters in ``box`` (x, y, w, h fractions).

    ``size`` is the height of a letter, fraction of the canvas.
    """
    H, W = canvas.shape
    alphabet = rng.random((26, 7, 5)) < 0.45
    letter_h = max(int(size * H), 4)
    letter_w = max(int(letter_h * 0.6), 3)
    x0, y0, x1, y1 = int(box[0] * W), int(box[1] * H), int((box[0] + box[2]) * W), int((box[1] + box[3]) * H)
    for y in range(y0, y1 - letter_h, int(letter_h * 1.7)):
        line_end = x1 - int(rng.uniform(0, 0.4) * (x1 - x0))
        for x in range(x0, line_end - letter_w, letter_w + max(letter_w // 4, 1)):
            if rng.random() < 0.15:
                continue
            glyph = alphabet[rng.integers(26)].astype(np.float32)
            cover = cv2.resize(glyph, (letter_w, letter_h), interpolation=cv2.INTER_LINEAR)
            patch = canvas[y : y + letter_h, x : x + letter_w]
            patch += (ink - patch) * cover


def _shapes(canvas: Float32Array, count: int, rng: np.random.Generator) -> None:
    """Random discs, polygons and bars, as in a photograph or an advertisement."""
    H, W = canvas.shape
    for _ in range(count):
        centre = np.array([rng.uniform(0, W), rng.uniform(0, H)])
        radius = float(rng.uniform(0.04, 0.28)) * min(H, W)
        value = float(rng.uniform(0.05, 0.9))
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(canvas, (int(centre[0]), int(centre[1])), int(radius), value, -1, cv2.LINE_8)
        elif kind == 1:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
            corners = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
            cv2.fillPoly(canvas, [corners.astype(np.int32)], value)
        else:
            end = centre + rng.normal(0, 2 * radius, 2)
            thickness = max(int(radius * 0.2), 1)
            cv2.line(canvas, (int(centre[0]), int(centre[1])), (int(end[0]), int(end[1])), value, thickness)


def _poster(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = rng.uniform(0.2, 0.85)
    H, W = canvas.shape
    cloud = cv2.resize(rng.normal(0, 0.12, (8, 8)).astype(np.float32), (W, H), interpolation=cv2.INTER_CUBIC)
    canvas += cloud
    _shapes(canvas, int(rng.integers(6, 22)), rng)
    _text(canvas, (0.08, 0.04, 0.84, 0.16), rng, float(rng.choice([0.05, 0.9])), 0.08)
    _text(canvas, (0.08, 0.7, 0.84, 0.28), rng, float(rng.choice([0.05, 0.9])), 0.025)
    _rectangle(canvas, 0, 0, 1, 0.012, 0.9)


def _notices(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = rng.uniform(0.35, 0.5)
    for _ in range(int(rng.integers(6, 14))):
        x, y = rng.uniform(0.02, 0.75), rng.uniform(0.02, 0.65)
        w, h = rng.uniform(0.12, 0.25), rng.uniform(0.18, 0.35)
        _rectangle(canvas, x, y, w, h, float(rng.uniform(0.6, 0.92)))
        _text(canvas, (x + 0.015, y + 0.02, w - 0.03, h - 0.03), rng, 0.15, 0.022)


def _whiteboard(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = 0.88
    H, W = canvas.shape
    for _ in range(int(rng.integers(3, 6))):
        points = np.cumsum(rng.normal(0, 0.05, (12, 2)), axis=0) + rng.uniform(0.15, 0.85, 2)
        cv2.polylines(canvas, [(points * [W, H]).astype(np.int32)], False, float(rng.uniform(0.15, 0.5)), 2)
    _text(canvas, (0.1, 0.1, 0.35, 0.4), rng, 0.25, 0.05)
    for x, y, w, h in ((0, 0, 1, 0.02), (0, 0.975, 1, 0.03), (0, 0, 0.012, 1), (0.985, 0, 0.02, 1)):
        _rectangle(canvas, x, y, w, h, 0.45)


def _bookshelf(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = 0.12
    boards = int(rng.integers(4, 6))
    for shelf in range(boards):
        y0, y1 = shelf / boards, (shelf + 1) / boards
        x = 0.03
        while x < 0.94:
            width = float(rng.uniform(0.02, 0.07))
            if rng.random() < 0.12:
                x += width * 1.5
                continue
            top = y0 + float(rng.uniform(0.03, 0.3)) / boards
            shade = float(rng.uniform(0.1, 0.9))
            _rectangle(canvas, x, top, min(width, 0.97 - x) - 0.004, y1 - top - 0.02, shade)
            ink = 0.9 if shade < 0.45 else 0.1
            for stripe in rng.uniform(0.1, 0.8, int(rng.integers(0, 4))):
                _rectangle(canvas, x + 0.004, top + (y1 - top) * stripe, width * 0.6, 0.008, ink)
            x += width
        _rectangle(canvas, 0, y1 - 0.018, 1, 0.018, 0.55)
    for x in (0.0, 0.975):
        _rectangle(canvas, x, 0, 0.025, 1, 0.55)


def _cabinet(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = rng.uniform(0.35, 0.75)
    columns, rows = int(rng.integers(1, 3)), int(rng.integers(2, 5))
    for column in range(columns):
        for row in range(rows):
            x, y, w, h = column / columns, row / rows, 1 / columns, 1 / rows
            _rectangle(canvas, x, y, w, 0.006, 0.15)
            _rectangle(canvas, x, y, 0.008, h, 0.15)
            _rectangle(canvas, x + 0.4 * w, y + 0.15 * h, 0.2 * w, 0.03 * h + 0.006, 0.1)
            if rng.random() < 0.5:
                _rectangle(canvas, x + 0.3 * w, y + 0.35 * h, 0.4 * w, 0.2 * h, 0.9)
                _text(canvas, (x + 0.32 * w, y + 0.36 * h, 0.36 * w, 0.18 * h), rng, 0.15, 0.03)


def _door(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = rng.uniform(0.3, 0.6)
    for x, y, w, h in ((0, 0, 1, 0.035), (0, 0, 0.07, 1), (0.93, 0, 0.07, 1)):
        _rectangle(canvas, x, y, w, h, 0.82)
    _rectangle(canvas, 0.82, 0.5, 0.1, 0.012, 0.1)
    _rectangle(canvas, 0.84, 0.49, 0.05, 0.09, 0.7)
    _rectangle(canvas, 0.3, 0.22, 0.4, 0.08, 0.9)
    _text(canvas, (0.33, 0.225, 0.36, 0.07), rng, 0.1, 0.03)
    if rng.random() < 0.5:
        _rectangle(canvas, 0.25, 0.38, 0.5, 0.22, float(rng.uniform(0.1, 0.9)))
        _text(canvas, (0.28, 0.39, 0.44, 0.2), rng, 0.4, 0.018)


def _screen(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = 0.06
    _rectangle(canvas, 0.04, 0.05, 0.92, 0.86, float(rng.uniform(0.15, 0.5)))
    for _ in range(4):
        x, y = rng.uniform(0.05, 0.5), rng.uniform(0.06, 0.5)
        _rectangle(canvas, x, y, 0.38, 0.36, float(rng.uniform(0.3, 0.9)))
        _text(canvas, (x + 0.02, y + 0.04, 0.34, 0.3), rng, 0.1, 0.04)


def _window(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = np.linspace(0.95, 0.55, len(canvas), dtype=np.float32)[:, None]
    for x in rng.uniform(0, 0.9, 7):
        top = rng.uniform(0.45, 0.75)
        _rectangle(canvas, float(x), float(top), float(rng.uniform(0.05, 0.2)), 1.0, float(rng.uniform(0.25, 0.6)))
    for x, y, w, h in ((0, 0, 1, 0.04), (0, 0.96, 1, 0.04), (0, 0, 0.035, 1), (0.965, 0, 0.04, 1), (0.485, 0, 0.03, 1)):
        _rectangle(canvas, x, y, w, h, 0.4)


def _pegboard(canvas: Float32Array, rng: np.random.Generator) -> None:
    canvas[:] = rng.uniform(0.45, 0.6)
    H, W = canvas.shape
    canvas[8::16, 8::16] = 0.1
    canvas[9::16, 8::16] = 0.1
    for _ in range(int(rng.integers(8, 18))):
        x, y = rng.uniform(0.05, 0.9), rng.uniform(0.05, 0.6)
        length, tilt = rng.uniform(0.12, 0.35), rng.normal(0, 0.03)
        start, end = (int(x * W), int(y * H)), (int((x + tilt) * W), int((y + length) * H))
        cv2.line(canvas, start, end, float(rng.uniform(0.05, 0.3)), max(W // 60, 2))
        cv2.circle(canvas, start, max(int(rng.uniform(0.01, 0.03) * W), 2), float(rng.uniform(0.05, 0.8)), -1)


def _panel(canvas: Float32Array, rng: np.random.Generator) -> None:
    """Front of a machine: plates, knobs, a grille and labels."""
    canvas[:] = rng.uniform(0.3, 0.55)
    H, W = canvas.shape
    for _ in range(int(rng.integers(3, 7))):
        x, y = rng.uniform(0.03, 0.7), rng.uniform(0.03, 0.8)
        w, h = rng.uniform(0.1, 0.3), rng.uniform(0.06, 0.2)
        _rectangle(canvas, x, y, w, h, float(rng.uniform(0.1, 0.85)))
        _text(canvas, (x + 0.01, y + 0.01, w - 0.02, h), rng, float(rng.uniform(0, 1)), 0.03)
    for _ in range(int(rng.integers(4, 12))):
        centre = (int(rng.uniform(0.05, 0.95) * W), int(rng.uniform(0.05, 0.95) * H))
        cv2.circle(canvas, centre, max(int(rng.uniform(0.01, 0.04) * W), 2), float(rng.uniform(0.05, 0.9)), -1)
    for y in np.arange(0.86, 0.97, 0.02):
        _rectangle(canvas, 0.1, float(y), 0.5, 0.006, 0.08)


def _desktop(canvas: Float32Array, rng: np.random.Generator) -> None:
    """Top of a desk: papers, pens, a cup's ring."""
    canvas[:] = rng.uniform(0.35, 0.6)
    H, W = canvas.shape
    canvas += cv2.resize(rng.normal(0, 0.03, (64, 4)).astype(np.float32), (W, H), interpolation=cv2.INTER_CUBIC)
    for _ in range(int(rng.integers(3, 9))):
        centre = rng.uniform(0.1, 0.9, 2) * [W, H]
        size = (int(rng.uniform(0.06, 0.16) * W), int(rng.uniform(0.1, 0.3) * W))
        corners = cv2.boxPoints((tuple(centre), size, float(rng.uniform(0, 180))))
        cv2.fillPoly(canvas, [corners.astype(np.int32)], float(rng.uniform(0.1, 0.95)))
    for _ in range(6):
        start = rng.uniform(0, 1, 2) * [W, H]
        end = start + rng.normal(0, 0.06 * W, 2)
        cv2.line(canvas, (int(start[0]), int(start[1])), (int(end[0]), int(end[1])), float(rng.uniform(0, 1)), 3)


def _label(canvas: Float32Array, rng: np.random.Generator) -> None:
    """Side of a carton or a sign: a label on an even ground."""
    canvas[:] = rng.uniform(0.3, 0.6)
    x, y = rng.uniform(0.1, 0.45, 2)
    _rectangle(canvas, x, y, 0.4, 0.35, 0.85)
    _text(canvas, (x + 0.03, y + 0.03, 0.34, 0.3), rng, 0.1, 0.06)
    _rectangle(canvas, 0, 0.485, 1, 0.03, float(rng.uniform(0.4, 0.7)))
    _shapes(canvas, 2, rng)


PICTURES: dict[str, Callable[[Float32Array, np.random.Generator], None]] = {
    "poster": _poster,
    "notices": _notices,
    "whiteboard": _whiteboard,
    "bookshelf": _bookshelf,
    "cabinet": _cabinet,
    "door": _door,
    "screen": _screen,
    "window": _window,
    "pegboard": _pegboard,
    "panel": _panel,
    "desktop": _desktop,
    "label": _label,
}
