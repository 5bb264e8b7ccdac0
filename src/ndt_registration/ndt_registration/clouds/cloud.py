# SPDX-License-Identifier: Apache-2.0
"""A cloud made ready for registration: finite, thinned, shuffled, near its sensor, with its own scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.clouds.edges import rim_points
from ndt_registration.clouds.moments import block_counts, block_moments
from ndt_registration.clouds.quantiles import quantiles, root_quantiles
from ndt_registration.clouds.visibility import mean_spacing, range_image
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import AnyArray

_COVERAGE_SIZE = 64
"""Size of the range image from which the part of the sphere that a scan covers is measured."""
_RIM_STEP = 0.04
"""Least gap in range at a rim, over the scale."""
_EVEN_SIZE = 0.01
"""Edge of the blocks of a crowded cloud, over the range that holds 90 % of its points."""
_CROWDED = 8.0
"""A cloud is crowded where a typical point's block has this many times the points of a typical block."""
_FARTHEST = 1e3
"""Points farther off than so many times the median distance are strays: no sensor sees them and a room."""
_FEWEST_RIMS = 60
"""Rims that go with even the smallest sample of points."""
_SEED = 20100610
"""Thinning is random but always the same: two runs on the same cloud give the same bytes."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3) m in random order, so that the first k are a fair sample of any size.

    rims (m, 3): points on the rims of things seen before a farther background.
    scale: median distance from the viewpoint, m, the unit of every length that no one has set. planar: the points came
    as (n, 2) and z is 0.
    """

    points: FloatArray
    rims: FloatArray
    scale: float
    planar: bool

    def sample(self, count: int) -> FloatArray:
        """A fair sample of at most ``count`` points."""
        return self.points[:count]

    def sample_rims(self, count: int) -> FloatArray:
        """The rims that go with a sample of ``count`` points: at least so many as make rims of use."""
        return self.rims[: max(count // 3, _FEWEST_RIMS)]

    def __len__(self) -> int:
        return len(self.points)


def finite_points(points: npt.ArrayLike) -> FloatArray:
    """Finite points as float64 (n, 3) of an array (..., 2) or (..., 3); z is 0 where there was none.

    Raises
    ------
    ValueError
        If the last dimension is neither 2 nor 3.
    """
    array = np.asarray(points)
    if array.dtype != np.float32:
        array = np.asarray(array, dtype=np.float64)
    if array.size == 0:
        return np.empty((0, 3))
    if array.ndim < 2 or array.shape[-1] not in (2, 3):
        raise ValueError(f"a cloud must have shape (..., 3) or (..., 2), got {array.shape}")
    return np.asarray(_finite_rows(np.ascontiguousarray(array.reshape(-1, array.shape[-1]))))


@njit(cache=True, nogil=True)
def _finite_rows(points: AnyArray) -> FloatArray:
    """Rows (n, 3) of float32 or float64 (m, 2) or (m, 3) without NaN and infinity, z 0 where there is none."""
    out, used = np.empty((points.shape[0], 3)), 0
    for i in range(points.shape[0]):
        x, y = float(points[i, 0]), float(points[i, 1])
        z = float(points[i, 2]) if points.shape[1] == 3 else 0.0
        if np.isfinite(x) and np.isfinite(y) and np.isfinite(z):
            out[used, 0], out[used, 1], out[used, 2] = x, y, z
            used += 1
    return out[:used]


@njit(cache=True, nogil=True)
def largest_extent(points: FloatArray) -> float:
    """Largest difference of a coordinate among points (n, 3), n > 0."""
    x0 = x1 = points[0, 0]
    y0 = y1 = points[0, 1]
    z0 = z1 = points[0, 2]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        x0, x1 = (x if x < x0 else x0), (x if x > x1 else x1)
        y0, y1 = (y if y < y0 else y0), (y if y > y1 else y1)
        z0, z1 = (z if z < z0 else z0), (z if z > z1 else z1)
    return float(max(x1 - x0, y1 - y0, z1 - z0))


def is_planar(points: npt.ArrayLike) -> bool:
    """True if a cloud is two-dimensional: shape (..., 2)."""
    return bool(np.shape(points)[-1:] == (2,))


def prepare(points: FloatArray, limit: int, *, planar: bool, centre: FloatArray) -> Cloud:
    """Thin finite points (n, 3) to at most ``limit`` and move ``centre`` to the origin."""
    return thinned(evened(points - centre if centre.any() else points), limit, planar=planar)


def evened(points: FloatArray) -> FloatArray:
    """Finite points (n, 3) without strays, and where they crowd together, their means in small blocks.

    Strays are so far off that cells of a useful size could not be numbered up to them. A turning scanner's points crowd
    near it: left alone, the floor at its feet would outweigh the whole building.
    """
    if len(points) == 0:
        return points
    squares = _squares(points)
    middle, far = root_quantiles(squares, (0.5, 0.9))
    farthest = _FARTHEST * middle
    if 0.0 < farthest < np.sqrt(squares.max()):
        points = points[np.sqrt(squares) <= farthest]
        far = root_quantiles(_squares(points), (0.9,))[0]
    size = _EVEN_SIZE * max(far, 1e-6)
    counts = block_counts(points, size)
    if not (counts**2).sum() / counts.sum() / quantiles(counts, (0.5,))[0] > _CROWDED:
        return points
    blocks = block_moments(points, size)
    return blocks.sums / blocks.counts[:, None]


def thinned(points: FloatArray, limit: int, *, planar: bool) -> Cloud:
    """The cloud of at most ``limit`` of :func:`evened` points (n, 3)."""
    rng = np.random.default_rng(_SEED)
    n = len(points)
    if n > limit:
        points = points[((np.arange(limit) + rng.random(limit)) * (n / limit)).astype(np.int64)]
    points = np.ascontiguousarray(points[rng.permutation(len(points))])
    scale = root_quantiles(_squares(points), (0.5,))[0] if len(points) else 0.0
    spacing = mean_spacing(points, range_image(points, _COVERAGE_SIZE), planar)
    rims = rim_points(points, spacing, _RIM_STEP * scale)
    return Cloud(points, rims[rng.permutation(len(rims))], scale, planar)


@njit(cache=True, nogil=True)
def _squares(points: FloatArray) -> FloatArray:
    """Squared distances (n,) m2 of points (n, 3) from the origin."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        out[i] = x * x + y * y + z * z
    return out


def viewpoint(points: FloatArray) -> FloatArray:
    """The origin if the cloud lies around it, as a scan does, else the centroid, as of a cloud in map coordinates.

    Angles and lengths are only comparable, and sums only exact, in coordinates that start near the points.
    """
    if len(points) == 0:
        return np.zeros(3)
    centroid = np.zeros(3)
    radius = _spread(points, centroid)
    return np.zeros(3) if np.linalg.norm(centroid) <= 4.0 * radius else centroid


@in_place()
def _spread(points: FloatArray, centroid: FloatArray) -> float:
    """Write the centroid (3,) of points (n, 3), n > 0; returns their root mean square distance from it."""
    n, squares = points.shape[0], 0.0
    for i in range(n):
        for k in range(3):
            centroid[k] += points[i, k]
    for k in range(3):
        centroid[k] /= n
    for i in range(n):
        for k in range(3):
            squares += (points[i, k] - centroid[k]) ** 2
    return float(np.sqrt(squares / n))
