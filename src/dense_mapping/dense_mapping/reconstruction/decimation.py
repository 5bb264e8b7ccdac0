# SPDX-License-Identifier: Apache-2.0
"""A coarser mesh for a page: vertices that share a cell become one (Rossignac and Borrel 1993)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dense_mapping.reconstruction.row_keys import row_keys
from dense_mapping.reconstruction.surface import Surface
from slam_core.types import AnyArray

_FIRST_CELL_M = 0.045


class _Cells(NamedTuple):
    """Cell of every vertex (n,), faces (k, 3) of cells, some more than once, and how many there are without these."""

    cell: npt.NDArray[np.int64]
    faces: npt.NDArray[np.int64]
    face_count: int


def at_most(surface: Surface, faces: int) -> Surface:
    """The surface itself, or the finest coarser one that has no more than so many faces."""
    if len(surface.faces) <= faces:
        return surface
    size, cells = _FIRST_CELL_M, _cells(surface, _FIRST_CELL_M)
    while cells.face_count > faces:
        size *= 1.25
        cells = _cells(surface, size)
    return _coarser(surface, cells)


def _cells(surface: Surface, size: float) -> _Cells:
    """The vertices by cells of ``size`` m, in the order of their places; a face within two cells is none."""
    # By sorting: without inverse or index NumPy 2.3 makes a table of values, and the search takes 2.5 times as long.
    cell = np.unique(row_keys(np.floor(surface.points / size).astype(np.int64)), return_inverse=True)[1]
    faces = cell[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return _Cells(cell, faces, len(np.unique(row_keys(faces), return_index=True)[0]))


def _coarser(surface: Surface, cells: _Cells) -> Surface:
    """One vertex in each cell, in the middle of those that were there."""
    cell, count = cells.cell, np.bincount(cells.cell)
    first = np.empty(len(count), dtype=np.int64)
    first[cell[::-1]] = np.arange(len(cell))[::-1]

    def mean(values: AnyArray) -> AnyArray:
        return np.stack([np.bincount(cell, column) for column in values.T], axis=1) / count[:, None]

    return replace(
        surface,
        points=mean(surface.points).astype(np.float32),
        normals=surface.normals[first],
        colours=np.rint(mean(surface.colours)).astype(np.uint8),
        sigma=surface.sigma[first],
        faces=cells.faces[np.unique(row_keys(cells.faces), return_index=True)[1]].astype(np.int32),
    )
