# SPDX-License-Identifier: Apache-2.0
"""Rotation search: the normals alone tell which rotations turn one scan's surfaces into those of another.

Two scans of one place show much the same set of surface directions, and a rotation matches the sets however far the
sensor has moved. So rotations are found first, apart from translations (compare Makadia et al. 2006 on extended
Gaussian images): three unknowns instead of six.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ndt_registration.clouds.moments import block_moments
from ndt_registration.clouds.visibility import direction_bin
from ndt_registration.clouds.voxel_grid import plane_fits
from slam_core.geometry import FloatArray, so3_exp
from slam_core.runtime.in_place import in_place

_IMAGE_SIZE = 48
"""Edge of the octahedral map of directions: bins of about 4 degrees."""
_COARSE_WIDTH = np.deg2rad(6.0)
_FINE_WIDTH = np.deg2rad(3.0)
"""Standard deviations of a normal, rad: for the lattice of rotations, and for that around its best."""
_FINE_RADIUS = np.deg2rad(6.0)
_FINE_STEP = np.deg2rad(2.5)
_SEPARATION = np.deg2rad(10.0)
"""Rotations nearer than this are the same hypothesis."""
_PREFERENCE = 0.05
"""Share of the score that the largest rotation loses: normals that all agree say nothing of turns about themselves."""
_FLAT = 0.35
"""Largest ratio of the standard deviations across and along a patch that has a normal."""
_FEWEST = 6
"""Fewest points of a patch."""


@lru_cache(maxsize=16)
def ball_lattice(radius: float, step: float, axes: tuple[int, ...]) -> FloatArray:
    """Points of a cubic lattice inside a ball, shape (k, 3); only the given axes are used."""
    reach = int(np.floor(radius / step + 1e-9))
    line = np.arange(-reach, reach + 1) * step
    grids = np.meshgrid(*[line if axis in axes else np.zeros(1) for axis in range(3)], indexing="ij")
    points = np.stack(grids, axis=-1).reshape(-1, 3)
    return np.asarray(points[np.linalg.norm(points, axis=1) <= radius * (1.0 + 1e-9)])


@lru_cache(maxsize=16)
def rotation_lattice(radius: float, step: float, axes: tuple[int, ...]) -> FloatArray:
    """Rotations (k, 3, 3) whose vectors, rad, form a lattice in a ball."""
    return so3_exp(ball_lattice(radius, step, axes))


def facing_normals(points: FloatArray, edge: float) -> FloatArray:
    """Normals (k, 3), towards the viewer at the origin, of the flat ones among a scan's patches of ``edge`` m."""
    mean, normal, variance = plane_fits(block_moments(points, edge), _FEWEST)
    flat = variance[:, 0] < _FLAT**2 * variance[:, 1]
    normal = normal[flat]
    return normal * np.where((normal * mean[flat]).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]


def best_rotations(source: FloatArray, target: FloatArray, largest: float, step: float, count: int) -> FloatArray:
    """The ``count`` best of all rotations up to ``largest`` rad, best first, shape (k, 3, 3).

    Parameters
    ----------
    source, target
        Unit normals (n, 3) and (m, 3).
    largest, step
        Greatest angle and spacing of the lattice, rad.
    count
        Most rotations, each well apart from the others.

    A wall has many normals and a chair few; both are told by their directions alike. So a direction counts with the
    root of how many point there.
    """
    if len(source) == 0 or len(target) == 0:
        return np.eye(3)[None]
    weights = 1.0 / np.sqrt(direction_density(source, source, _COARSE_WIDTH))
    weights /= weights.sum()
    vectors, rotations = ball_lattice(largest, step, (0, 1, 2)), rotation_lattice(largest, step, (0, 1, 2))
    scores = rotation_scores(rotations, source, weights, _direction_image(target, _COARSE_WIDTH), _IMAGE_SIZE)
    scores -= _PREFERENCE * scores.max() * np.linalg.norm(vectors, axis=1) / max(largest, step)
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        if all(np.linalg.norm(vectors[k] - vectors[j]) > _SEPARATION for j in kept):
            kept.append(int(k))
        if len(kept) == count:
            break
    around, fine = rotation_lattice(_FINE_RADIUS, _FINE_STEP, (0, 1, 2)), _direction_image(target, _FINE_WIDTH)
    turned = [around @ rotations[k] for k in kept]
    return np.array([R[rotation_scores(R, source, weights, fine, _IMAGE_SIZE).argmax()] for R in turned])


@lru_cache(maxsize=1)
def _bin_directions() -> FloatArray:
    """Unit directions (n, 3) of the centres of the octahedral map's bins; see ``direction_bin``."""
    line = (np.arange(_IMAGE_SIZE) + 0.5) / _IMAGE_SIZE * 2.0 - 1.0
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    z = 1.0 - np.abs(u) - np.abs(v)
    x = np.where(z < 0.0, (1.0 - np.abs(v)) * np.where(u >= 0.0, 1.0, -1.0), u)
    y = np.where(z < 0.0, (1.0 - np.abs(u)) * np.where(v >= 0.0, 1.0, -1.0), v)
    directions = np.column_stack([x, y, z])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _direction_image(normals: FloatArray, width: float) -> FloatArray:
    """Root of the density of normals in every bin, at most 1."""
    image = np.sqrt(direction_density(_bin_directions(), normals, width))
    return np.asarray(image / max(image.max(), 1e-300))


def direction_density(directions: FloatArray, normals: FloatArray, width: float) -> FloatArray:
    """Mean over normals (n, 3) of a bell of standard deviation ``width`` rad, at unit directions (k, 3)."""
    out = np.empty(len(directions))
    _fill_density(directions, np.ascontiguousarray(normals.T), 1.0 / (width * width), out)
    return out


# Here and below no branch and sums in any order: so the compiler takes eight normals at once.
@in_place(fastmath={"reassoc"}, error_model="numpy")
def _fill_density(directions, normals, inverse_variance, out):  # type: ignore[no-untyped-def]
    """The bell is 0 beyond four standard deviations: a power of 16 of a Taylor series, which errs by 1e-7."""
    nx, ny, nz = normals[0], normals[1], normals[2]
    for i in range(directions.shape[0]):
        x, y, z, total = directions[i, 0], directions[i, 1], directions[i, 2], 0.0
        for j in range(normals.shape[1]):
            exponent = (1.0 - (x * nx[j] + y * ny[j] + z * nz[j])) * inverse_variance
            t = min(exponent, _FARTHEST_EXPONENT) * (-1.0 / 16.0)
            e = 1.0 + t * (1.0 + t * (0.5 + t * (_C3 + t * (_C4 + t * (_C5 + t * (_C6 + t * (_C7 + t * _C8)))))))
            e *= e
            e *= e
            e *= e
            e *= e
            total += e if exponent < _FARTHEST_EXPONENT else 0.0
        out[i] = total / normals.shape[1]


_FARTHEST_EXPONENT = 8.0
_C3, _C4, _C5, _C6, _C7, _C8 = 1 / 6, 1 / 24, 1 / 120, 1 / 720, 1 / 5040, 1 / 40320


def rotation_scores(
    rotations: FloatArray, normals: FloatArray, weights: FloatArray, image: FloatArray, size: int
) -> FloatArray:
    """Weighted mean of an image of directions at the normals (n, 3) turned by each rotation (k, 3, 3)."""
    out = np.empty(len(rotations))
    _fill_scores(rotations, np.ascontiguousarray(normals.T), weights, image, np.int32(size), out)
    return out


@in_place(fastmath={"reassoc"}, error_model="numpy")
def _fill_scores(rotations, normals, weights, image, size, out):  # type: ignore[no-untyped-def]
    nx, ny, nz = normals[0], normals[1], normals[2]
    for k in range(rotations.shape[0]):
        xa, xb, xc = rotations[k, 0, 0], rotations[k, 0, 1], rotations[k, 0, 2]
        ya, yb, yc = rotations[k, 1, 0], rotations[k, 1, 1], rotations[k, 1, 2]
        za, zb, zc = rotations[k, 2, 0], rotations[k, 2, 1], rotations[k, 2, 2]
        total = 0.0
        for i in range(normals.shape[1]):
            a, b, c = nx[i], ny[i], nz[i]
            x, y, z = xa * a + xb * b + xc * c, ya * a + yb * b + yc * c, za * a + zb * b + zc * c
            total += weights[i] * image[direction_bin(x, y, z, size)]
        out[k] = total
