# SPDX-License-Identifier: Apache-2.0
"""A coarser mesh for a page: vertices that share a cell become one (Rossignac and Borrel 1993)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dense_mapping.surface import Surface

_FIRST_CELL_M = 0.045


def at_most(surface: Surface, faces: int) -> Surface:
    """The surface itself, or the finest coarser one that has no more than so many faces."""
    size, coarse = _FIRST_CELL_M, surface
    while len(coarse.faces) > faces:
        coarse = coarser(surface, size)
        size *= 1.25
    return coarse


def coarser(surface: Surface, size: float) -> Surface:
    """The surface with one vertex in each cell of ``size`` m, in the middle of those that were there."""
    _, first, cell, count = np.unique(
        np.floor(surface.points / size).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    cell = cell.ravel()

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, column) for column in values.T], axis=1) / count[:, None]

    faces = cell[surface.faces].astype(np.int32)
    a, b, c = faces.T
    return replace(
        surface,
        points=mean(surface.points).astype(np.float32),
        normals=surface.normals[first],
        colours=np.rint(mean(surface.colours)).astype(np.uint8),
        sigma=surface.sigma[first],
        faces=np.unique(faces[(a != b) & (b != c) & (c != a)], axis=0),
    )
