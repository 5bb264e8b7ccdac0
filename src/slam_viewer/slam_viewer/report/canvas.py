# SPDX-License-Identifier: Apache-2.0
"""Blank figures with margins of fixed width: a layout that looks for them draws every figure twice."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH = 7.5
"""Inches: text of ten points is then as large as the report's own where the page is wide."""
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.75, 0.15, 0.5, 0.35
"""Room (inches) for labels and titles around the axes."""
_LOWEST = 1.5
"""Height (inches) that axes keep for their legend."""
_BETWEEN = (0.65, 0.3)
"""Room (inches) between columns and between rows of axes."""

_TICKS = 6
"""Steps between the ticks of an axis, at most: each takes half a millisecond to draw."""


def blank(
    height: float, rows: int = 1, columns: int = 1, *, sharex: bool = True
) -> tuple[Figure, npt.NDArray[np.object_]]:
    """A figure, :data:`WIDTH` by ``height`` inches, and its axes (rows, columns), which share x unless not wanted."""
    figure = Figure(figsize=(WIDTH, height))
    across = (WIDTH - _LEFT - _RIGHT - (columns - 1) * _BETWEEN[0]) / columns
    along = (height - _BOTTOM - _TOP - (rows - 1) * _BETWEEN[1]) / rows
    axes = figure.subplots(
        rows,
        columns,
        sharex=sharex,
        squeeze=False,
        gridspec_kw={
            "left": _LEFT / WIDTH,
            "right": 1.0 - _RIGHT / WIDTH,
            "bottom": _BOTTOM / height,
            "top": 1.0 - _TOP / height,
            "wspace": _BETWEEN[0] / across,
            "hspace": _BETWEEN[1] / along,
        },
    )
    for each in axes.ravel():
        each.locator_params(nbins=_TICKS)
    return figure, axes


def draw_to_scale(figure: Figure, axes: Axes) -> None:
    """Give the only axes of a figure equal scales, and the figure no more height than they then fill."""
    axes.set_aspect("equal", adjustable="box")
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    width, height = figure.get_size_inches()
    filled = (width - _LEFT - _RIGHT) * (high - low) / (right - left)
    height = min(height, max(filled, _LOWEST) + _BOTTOM + _TOP)
    figure.set_figheight(height)
    across, along = 1.0 - (_LEFT + _RIGHT) / width, 1.0 - (_BOTTOM + _TOP) / height
    axes.set_position((_LEFT / width, _BOTTOM / height, across, along))
