# SPDX-License-Identifier: Apache-2.0
"""The surface of a TSDF as a triangle mesh whose vertices know their normal, colour and standard deviation.

Marching cubes (Lorensen and Cline 1987; PyMCubes) runs over cubes of blocks. A voxel that was not seen well enough is
NaN: every triangle that it would shape is dropped, so the mesh ends where the knowledge ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import mcubes
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dense_mapping.tsdf import TsdfVolume
from dense_mapping.tsdf_kernels import BLOCK
from slam_core.config import Config
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray, Float32Array

_SIGMA_FLOOR = 0.002
"""Standard deviation that no number of images improves: calibration, grid."""
_CORRELATION = 0.15
"""Share of the variance that the key frames of one place have in common."""
_MIN_TRIANGLES = 60
"""Connected pieces with fewer triangles are left out."""
_FACES_AT_ONCE = 50_000
"""Triangles whose normals are computed at once, for the sake of memory."""

_CHUNK = 6
"""Blocks along the edge of a cube that marching cubes runs over at once."""
_UNSEEN = 150
"""Grey of a surface that no picture shows."""


@dataclass(frozen=True)
class SurfaceConfig(Config):
    """Choice of the voxels that shape the surface."""

    min_images: int = 2
    """A voxel counts from so many key frames on."""
    max_sigma: float = 0.06
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


def extract_surface(volume: TsdfVolume, config: SurfaceConfig) -> Surface:
    """The zero level of the field, with everything known of it."""
    pieces = [_chunk_surface(volume, chunk, config) for chunk in _chunks(volume)]
    pieces = [piece for piece in pieces if len(piece[1])]
    if not pieces:
        return Surface.empty()
    offsets = np.cumsum([0, *(len(points) for points, *_ in pieces)])
    points, colours, sigma = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 2, 3))
    faces = np.concatenate([piece[1] + offset for piece, offset in zip(pieces, offsets, strict=False)])
    points, faces, kept = _welded(points, faces, volume.config.voxel_size)
    faces = _without_islands(faces, len(points), _MIN_TRIANGLES)
    used, faces = _renumbered(faces, len(points))
    points = points[used]
    return Surface(points, _normals(points, faces), colours[kept][used], sigma[kept][used], faces)


def voxel_statistics(voxels: Float32Array, config: SurfaceConfig) -> tuple[Float32Array, Float32Array]:
    """Mean distance (..., ) m of each voxel and its standard deviation, NaN where it was not seen well enough.

    The spread of the images about their mean widens what their sigmas claim, and never narrows it; a share of the
    variance, ``correlation``, stays however many images there are, because neighbours see a place with equal errors.
    """
    weighted, weight, squared, number = np.moveaxis(voxels, -1, 0)
    seen = (number >= config.min_images - 0.5) & (weight > 0.0)
    w, count = weight[seen].astype(np.float64), number[seen].astype(np.float64)
    seen_mean = weighted[seen] / w
    spread = np.maximum(squared[seen] - weighted[seen] * seen_mean, 0.0) / np.maximum(count - 1.0, 1.0)
    variance = np.maximum(spread, 1.0) * (1.0 + (count - 1.0) * _CORRELATION) / w + _SIGMA_FLOOR**2
    seen_sigma = np.sqrt(variance)
    known = seen_sigma <= config.max_sigma
    mean, sigma = (np.full(seen.shape, np.nan, dtype=np.float32) for _ in range(2))
    mean[seen], sigma[seen] = np.where(known, seen_mean, np.nan), np.where(known, seen_sigma, np.nan)
    return mean, sigma


def _chunks(volume: TsdfVolume) -> npt.NDArray[np.int64]:
    """Places (n, 3), on a grid of cubes of blocks, of the cubes that hold blocks, in a fixed order."""
    return np.unique(volume.coordinates // _CHUNK, axis=0)


def _chunk_surface(
    volume: TsdfVolume, chunk: npt.NDArray[np.int64], config: SurfaceConfig
) -> tuple[Float32Array, npt.NDArray[np.int32], ByteArray, Float32Array]:
    """Points, faces, colours and sigma of one cube of blocks, one voxel of overlap with the next cubes."""
    corner = chunk * _CHUNK
    size = (_CHUNK + 1) * BLOCK
    distance = np.full((size, size, size), np.nan, dtype=np.float32)
    sigma = np.full((size, size, size), np.nan, dtype=np.float32)
    colours = np.zeros((size, size, size, 3), dtype=np.uint8)
    inside = np.flatnonzero(((volume.coordinates >= corner) & (volume.coordinates <= corner + _CHUNK)).all(axis=1))
    means, sigmas = voxel_statistics(volume.voxels[inside], config)
    shown = volume.colours[inside]
    for values, target in (
        (means, distance),
        (sigmas, sigma),
        (np.where(shown[..., 3:] > 0, shown[..., :3], _UNSEEN), colours),
    ):
        _put_blocks(values, volume.coordinates[inside] - corner, target)
    edge = _CHUNK * BLOCK + 1
    distance = distance[:edge, :edge, :edge]
    if not (distance < 0.0).any() or not (distance > 0.0).any():
        return _nothing()
    vertices, triangles = mcubes.marching_cubes(distance, 0.0)
    triangles = triangles[np.isfinite(vertices).all(axis=1)[triangles].all(axis=1)].astype(np.int64)
    used, faces = _renumbered(triangles, len(vertices))
    vertices = vertices[used]
    nearest = tuple(np.rint(vertices).astype(np.int64).T)
    points = (corner * volume.block_size + (vertices + 0.5) * volume.config.voxel_size).astype(np.float32)
    return points, faces[:, ::-1].astype(np.int32), colours[nearest], sigma[nearest]


def _put_blocks(values: AnyArray, places: npt.NDArray[np.int64], target: AnyArray) -> None:
    """Write the voxels (n, 512, ...) of blocks at places (n, 3), counted in blocks, into a cube of voxels."""
    blocks, rest = len(target) // BLOCK, target.shape[3:]
    x, y, z = places.T
    target.reshape(*(blocks, BLOCK) * 3, *rest)[x, :, y, :, z] = values.reshape(-1, BLOCK, BLOCK, BLOCK, *rest)


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
    order = np.lexsort(cells.T[::-1])
    begins = np.concatenate([[True], (np.diff(cells[order], axis=0) != 0).any(axis=1)])
    kept, inverse = order[begins], np.empty(len(order), dtype=np.int64)
    inverse[order] = np.cumsum(begins) - 1
    faces = inverse[faces].astype(np.int32)
    a, b, c = faces.T
    return points[kept], faces[(a != b) & (b != c) & (c != a)], kept


def _without_islands(faces: npt.NDArray[np.int32], count: int, least: int) -> npt.NDArray[np.int32]:
    """Faces of connected pieces with at least ``least`` triangles."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.asarray(faces[np.bincount(piece)[piece] >= least])


def _normals(points: Float32Array, faces: npt.NDArray[np.int32]) -> Float32Array:
    """Unit normals of the vertices, from the triangles around each, by area."""
    total = np.zeros((3, len(points)))
    for first in range(0, len(faces), _FACES_AT_ONCE):
        some = faces[first : first + _FACES_AT_ONCE]
        a, b, c = (points[some[:, k]].astype(np.float64) for k in range(3))
        across = np.cross(b - a, c - a)
        for k in range(3):
            np.add.at(total[k], some.ravel(), np.repeat(across[:, k], 3))
    total = total.T
    length: FloatArray = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-12)).astype(np.float32)
