# SPDX-License-Identifier: Apache-2.0
"""The surface of a TSDF as a triangle mesh whose vertices know their normal, colour and standard deviation.

Marching cubes (Lorensen and Cline 1987) runs over cubes of blocks. A voxel that was not seen well enough is NaN: every
triangle that it would shape is dropped, so the mesh ends where the knowledge ends.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dense_mapping.reconstruction.cube_triangles import triangle_table
from dense_mapping.reconstruction.row_keys import row_keys
from dense_mapping.reconstruction.surface_kernels import add_normals, fill_means, march, pieces
from dense_mapping.reconstruction.tsdf import TsdfVolume
from dense_mapping.reconstruction.tsdf_kernels import BLOCK
from slam_core.geometry import FloatArray
from slam_core.types import ByteArray, Float32Array

_SIGMA_FLOOR = 0.002
"""Standard deviation that no number of images improves: calibration, grid."""
_CORRELATION = 0.15
"""Share of the variance that the key frames of one place have in common."""
_MIN_TRIANGLES = 60
"""Connected pieces with fewer triangles are left out."""

_CHUNK = 6
"""Blocks along the edge of a cube that marching cubes runs over at once."""
_THREADS = 2
"""Cubes at once; more threads would only wait for the interpreter between their kernels."""
_UNSEEN = 150
"""Grey of a surface that no picture shows."""
_MAX_SIGMA = 0.06
"""Voxels whose distance is less certain are left out, m."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh in the map frame.

    points (n, 3) m; normals (n, 3), unit, towards the free side; colours (n, 3) uint8; sigma (n,) m, standard deviation
    along the normal, given the poses; faces (m, 3) rows of ``points``.
    """

    points: Float32Array
    normals: Float32Array
    colours: ByteArray
    sigma: Float32Array
    faces: npt.NDArray[np.int32]

    @classmethod
    def empty(cls) -> Surface:
        """A surface without points."""
        zeros = np.empty((0, 3), dtype=np.float32)
        return cls(zeros, zeros, np.empty((0, 3), np.uint8), np.empty(0, np.float32), np.empty((0, 3), np.int32))

    def __len__(self) -> int:
        return len(self.points)


def extract_surface(volume: TsdfVolume, *, release: bool = False) -> Surface:
    """The zero level of the field, with everything known of it; ``release``: the field is emptied on the way."""
    voxel_size = volume.config.voxel_size
    with ThreadPoolExecutor(_THREADS) as pool:
        pieces = list(pool.map(lambda chunk: _chunk_surface(volume, chunk), _chunks(volume)))
    pieces = [piece for piece in pieces if len(piece[1])]
    if release:  # by far the largest part, and what follows needs room
        volume.clear()
    if not pieces:
        return Surface.empty()
    offsets = np.cumsum([0, *(len(points) for points, *_ in pieces)])
    points, colours, sigma = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 2, 3))
    faces = np.concatenate([piece[1] + offset for piece, offset in zip(pieces, offsets.astype(np.int32), strict=False)])
    del pieces
    points, faces, kept = _welded(points, faces, voxel_size)
    faces = _without_islands(faces, len(points), _MIN_TRIANGLES)
    used, faces = _renumbered(faces, len(points))
    points = points[used]
    return Surface(points, _normals(points, faces), colours[kept][used], sigma[kept][used], faces)


def voxel_statistics(voxels: Float32Array, min_images: int) -> tuple[Float32Array, Float32Array]:
    """Mean distance (..., ) m of each voxel and its standard deviation, NaN where it was not seen well enough.

    The spread of the images about their mean widens what their sigmas claim, and never narrows it; a share of the
    variance, ``correlation``, stays however many images there are, because neighbours see a place with equal errors.
    """
    weighted, weight, squared, number = np.moveaxis(voxels, -1, 0)
    seen = (number >= min_images - 0.5) & (weight > 0.0)
    w, count = weight[seen].astype(np.float64), number[seen].astype(np.float64)
    seen_mean = weighted[seen] / w
    spread = np.maximum(squared[seen] - weighted[seen] * seen_mean, 0.0) / np.maximum(count - 1.0, 1.0)
    variance = np.maximum(spread, 1.0) * (1.0 + (count - 1.0) * _CORRELATION) / w + _SIGMA_FLOOR**2
    seen_sigma = np.sqrt(variance)
    known = seen_sigma <= _MAX_SIGMA
    mean, sigma = (np.full(seen.shape, np.nan, dtype=np.float32) for _ in range(2))
    mean[seen], sigma[seen] = np.where(known, seen_mean, np.nan), np.where(known, seen_sigma, np.nan)
    return mean, sigma


def _chunks(volume: TsdfVolume) -> npt.NDArray[np.int64]:
    """Places (n, 3), on a grid of cubes of blocks, of the cubes that hold blocks, in a fixed order."""
    return np.unique(volume.coordinates // _CHUNK, axis=0)


def _chunk_surface(
    volume: TsdfVolume, chunk: npt.NDArray[np.int64]
) -> tuple[Float32Array, npt.NDArray[np.int32], ByteArray, Float32Array]:
    """Points, faces, colours and sigma of one cube of blocks, one voxel of overlap with the next cubes."""
    corner = chunk * _CHUNK
    inside = np.flatnonzero(((volume.coordinates >= corner) & (volume.coordinates <= corner + _CHUNK)).all(axis=1))
    rows = np.zeros((_CHUNK + 1,) * 3, dtype=np.int64)
    rows[tuple((volume.coordinates[inside] - corner).T)] = inside
    edge = _CHUNK * BLOCK + 1
    distance = np.full(((_CHUNK + 1) * BLOCK,) * 3, np.nan, dtype=np.float32)
    min_images = volume.config.min_images
    limits, noise = (min_images, _MAX_SIGMA), (_CORRELATION, _SIGMA_FLOOR)
    fill_means(volume.voxels, inside, (volume.coordinates[inside] - corner) * BLOCK, limits, noise, distance)
    vertices, voxels, faces = march(distance[:edge, :edge, :edge], triangle_table())
    if not len(faces):
        return _nothing()
    used, faces = _renumbered(faces, len(vertices))
    points = (corner * volume.block_size + (vertices[used] + 0.5) * volume.config.voxel_size).astype(np.float32)
    block, (x, y, z) = rows[tuple((voxels[used] // BLOCK).T)], (voxels[used] % BLOCK).T
    voxel = (x * BLOCK + y) * BLOCK + z
    shown = volume.colours[block, voxel]
    colours = np.where(shown[:, 3:] > 0, shown[:, :3], np.uint8(_UNSEEN))
    return points, faces, colours, voxel_statistics(volume.voxels[block, voxel], min_images)[1]


def _nothing() -> tuple[Float32Array, npt.NDArray[np.int32], ByteArray, Float32Array]:
    empty = Surface.empty()
    return empty.points, empty.faces, empty.colours, empty.sigma


def _renumbered(faces: npt.NDArray[np.integer], count: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Rows of the points that ``faces`` use, and the faces in terms of these."""
    used = np.zeros(count, dtype=bool)
    used[faces] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[faces].astype(np.int32)


def _welded(
    points: Float32Array, faces: npt.NDArray[np.int32], voxel_size: float
) -> tuple[Float32Array, npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Points of neighbouring cubes that are one made one, and triangles without area dropped."""
    cells = np.rint(points.astype(np.float64) / (1e-3 * voxel_size)).astype(np.int64)
    _, kept, inverse = np.unique(row_keys(cells), return_index=True, return_inverse=True)
    faces = inverse[faces].astype(np.int32)
    a, b, c = faces.T
    return points[kept], faces[(a != b) & (b != c) & (c != a)], kept


def _without_islands(faces: npt.NDArray[np.int32], count: int, least: int) -> npt.NDArray[np.int32]:
    """Faces of connected pieces with at least ``least`` triangles."""
    piece = pieces(faces, count)[faces[:, 0]]
    return np.asarray(faces[np.bincount(piece)[piece] >= least]) if len(faces) else faces


def _normals(points: Float32Array, faces: npt.NDArray[np.int32]) -> Float32Array:
    """Unit normals of the vertices, from the triangles around each, by area."""
    total = np.zeros((len(points), 3))
    add_normals(points, faces, total)
    length: FloatArray = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-12)).astype(np.float32)
