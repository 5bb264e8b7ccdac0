# SPDX-License-Identifier: Apache-2.0
"""Loss of score when a pose is moved: how well a scan determines it.

Only points that lie on the map before and after count, each by its mean over the cells that are there. Else every view
would seem to hold itself: where it ends, points leave the map with any motion, before a blank wall as well as before a
bookcase.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ndt_registration.ndt import Layer
from ndt_registration.voxel_grid import find_block
from slam_core.geometry import FloatArray, boxplus
from slam_core.in_place import in_place


class ScoreLoss:
    """The fit at a pose T_target_source (4, 4), to be compared with the fit near it; surfaces and rims as layers."""

    def __init__(self, layers: tuple[Layer, Layer], T: FloatArray) -> None:
        self._layers, self._T = layers, T
        self._fits = self._at(T)

    def loss(self, step: FloatArray) -> float:
        """Share of the fit that is lost when the pose is moved by a vector (6,)."""
        surfaces, rims = self._fits
        moved_surfaces, moved_rims = self._at(boxplus(self._T, step))
        both = (surfaces >= 0.0) & (moved_surfaces >= 0.0)
        # Rims mark where a surface ends: one that leaves them is lost indeed.
        weight = self._layers[1].factor
        before = surfaces[both].sum() + weight * np.maximum(rims, 0.0).sum()
        after = moved_surfaces[both].sum() + weight * np.maximum(moved_rims, 0.0).sum()
        return 1.0 - float(after) / max(float(before), 1e-300)

    def _at(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
        surfaces, rims = self._layers
        return point_fits(surfaces, R, t), point_fits(rims, R, t)


@njit(cache=True, nogil=True)
def point_fits(layer: Layer, R: FloatArray, t: FloatArray) -> FloatArray:
    """Mean of ``exp(-1/2 q' B q)`` (Eq. 8.5) over the cells that cover each point, -1 where none does, shape (n,)."""
    out = np.full(layer.points.shape[0], -1.0)
    _fill_fits(layer, R, t, out)
    return out


@in_place()
def _fill_fits(layer: Layer, R: FloatArray, t: FloatArray, out: FloatArray) -> None:
    grid = layer.grid
    s = 1.0 / grid.block_size
    for i in range(layer.points.shape[0]):
        x, y, z = layer.points[i, 0], layer.points[i, 1], layer.points[i, 2]
        mx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        my = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        mz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        row = find_block(grid.keys, grid.rows, int(np.floor(mx * s)), int(np.floor(my * s)), int(np.floor(mz * s)))
        if row < 0:
            continue
        total, cells = 0.0, 0
        for k in range(8):
            cell = grid.cells[row, k]
            if cell < 0:
                continue
            qx, qy, qz = mx - grid.mean[cell, 0], my - grid.mean[cell, 1], mz - grid.mean[cell, 2]
            b = grid.information[cell]
            ux = b[0] * qx + b[1] * qy + b[2] * qz
            uy = b[1] * qx + b[3] * qy + b[4] * qz
            uz = b[2] * qx + b[4] * qy + b[5] * qz
            total += np.exp(-min(0.5 * (qx * ux + qy * uy + qz * uz), 30.0))
            cells += 1
        out[i] = total / cells
