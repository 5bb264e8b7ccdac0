# SPDX-License-Identifier: Apache-2.0
"""Loss of score when a pose is moved: how well a scan determines it.

Only points that lie on the map before and after count, each by its mean over the cells that are there. Else every view
would seem to hold itself: where it ends, points leave the map with any motion, before a blank wall as well as before a
bookcase.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ndt_registration.methods.lanes import LANES, NOWHERE, Neighbours, gather, groups_of, mean_over_cells, no_neighbours
from ndt_registration.methods.ndt import Layer
from slam_core.geometry import FloatArray, boxplus
from slam_core.runtime.in_place import in_place

_COARSE_STRIDE = 4
"""One in so many points tells at once where a pose is held without doubt."""


class ScoreLoss:
    """The fit at a pose T_target_source (4, 4), to be compared with the fit near it; surfaces and rims as layers.

    clear: a share of that size, lost by a quarter of the points, needs no look at the others.
    """

    def __init__(self, layers: tuple[Layer, Layer], T: FloatArray, clear: float = 1.0) -> None:
        self._layers, self._T, self._clear = layers, T, clear
        R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
        self._fits = point_fits(layers[0], R, t), point_fits(layers[1], R, t)

    def loss(self, step: FloatArray) -> float:
        """Share of the fit that is lost when the pose is moved by a vector (6,), or back by it: the lesser of both."""
        moved = [boxplus(self._T, step), boxplus(self._T, -step)]
        R, t = np.stack([T[:3, :3] for T in moved]), np.stack([T[:3, 3] for T in moved])
        few = self._lost(_COARSE_STRIDE, R, t)
        return few if few > self._clear else self._lost(1, R, t)

    def _lost(self, share: int, R: FloatArray, t: FloatArray) -> float:
        surfaces, rims = self._layers
        return float(
            least_loss(
                surfaces._replace(points=surfaces.points[: len(surfaces.points) // share]),
                rims._replace(points=rims.points[: len(rims.points) // share]),
                *self._fits,
                R,
                t,
            )
        )


@njit(cache=True, nogil=True)
def least_loss(
    surfaces: Layer, rims: Layer, fits: FloatArray, rim_fits: FloatArray, R: FloatArray, t: FloatArray
) -> float:
    """Least share of the fits before (n,) and (m,) that is lost at any of the poses (k, 3, 3), (k, 3)."""
    at, least = no_neighbours(1), 1.0
    for k in range(R.shape[0]):
        before, after = _sums_of_both(surfaces, fits, True, R[k], t[k], at)
        at.block[:] = NOWHERE  # what follows has another grid
        rims_before, rims_after = _sums_of_both(rims, rim_fits, False, R[k], t[k], at)
        at.block[:] = NOWHERE
        before, after = before + rims.factor * rims_before, after + rims.factor * rims_after
        least = min(least, 1.0 - after / max(before, 1e-300))
    return least


@in_place()
def _sums_of_both(
    layer: Layer, fits: FloatArray, on_the_map: bool, R: FloatArray, t: FloatArray, at: Neighbours
) -> tuple[float, float]:
    """Sums of the fits before and at a pose; of points that lie on the map both times, if so asked.

    Rims mark where a surface ends: one that leaves them is lost indeed.
    """
    before = after = 0.0
    for group in range(groups_of(layer.points.shape[0])):
        count = gather(layer.points, group, layer.grid, R, t, at, -group)
        mean_over_cells(at.cells[0], at.place, at.sums)
        for j in range(count):
            fit, moved = fits[group * LANES + j], at.sums[j]
            if not on_the_map or (fit >= 0.0 and moved >= 0.0):
                before += max(fit, 0.0)
                after += max(moved, 0.0)
    return before, after


@njit(cache=True, nogil=True)
def point_fits(layer: Layer, R: FloatArray, t: FloatArray) -> FloatArray:
    """Mean of ``exp(-1/2 q' B q)`` (Eq. 8.5) over the cells that cover each point, -1 where none does, shape (n,)."""
    out = np.empty(layer.points.shape[0])
    _fill_fits(layer, R, t, no_neighbours(1), out)
    return out


@in_place()
def _fill_fits(layer: Layer, R: FloatArray, t: FloatArray, at: Neighbours, out: FloatArray) -> None:
    for group in range(groups_of(layer.points.shape[0])):
        count = gather(layer.points, group, layer.grid, R, t, at, -group)
        mean_over_cells(at.cells[0], at.place, at.sums)
        for j in range(count):
            out[group * LANES + j] = at.sums[j]
