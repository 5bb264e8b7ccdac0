# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field in sparse blocks of voxels (Curless and Levoy 1996; Niessner et al. 2013).

Every voxel near a surface keeps the mean of its distance to the surface along the rays that saw it, weighted by the
inverse variance of the depth. The surface is where the mean is zero, so noise averages out as in any least squares.
The sums are linear: an image whose pose has changed is taken away where it was and added where it belongs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dense_mapping.reconstruction.tsdf_kernels import BLOCK, VOXELS, DepthView, integrate, surface_blocks
from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import ByteArray, Float32Array

_TRUNCATION_VOXELS = 3.0
"""Distances are kept up to so many voxels."""
_RECENT = 1 << 12
"""Blocks that a look through a depth image remembers, a power of two."""
_KEY_RANGE = 1 << 20
"""Block coordinates lie within plus and minus half of this."""


@dataclass(frozen=True)
class TsdfConfig(Config):
    """The grid of the dense model."""

    voxel_size: float = parameter(0.03, "edge of a voxel", unit="m", minimum=0.005, maximum=0.5)
    max_blocks: int = parameter(60000, "blocks of 8 x 8 x 8 voxels (10 kB each) beyond which none is added", minimum=1)
    min_images: int = parameter(
        2, "key frames that must have seen a voxel for it to count; slam post has 1, since it asks for single ones",
        minimum=1, maximum=100,
    )  # fmt: skip


class TsdfVolume:
    """Blocks of voxels, made where depth images have surfaces.

    Attributes
    ----------
    coordinates
        (n, 3) int64, the blocks' places on the grid of blocks.
    voxels
        (n, 512, 4) float32: sum of weighted distance (m), of weight (1/m2), of weighted squared distance, number of
        images. Index of a voxel in its block: (x * 8 + y) * 8 + z.
    colours
        (n, 512, 4) uint8: red, green, blue, number of images.
    refused_blocks
        How many blocks ``max_blocks`` kept out.
    """

    def __init__(self, config: TsdfConfig) -> None:
        self.config = config
        self.truncation = _TRUNCATION_VOXELS * config.voxel_size
        self.block_size = BLOCK * config.voxel_size
        self.refused_blocks = 0
        self.clear()

    def clear(self) -> None:
        """Forget all blocks."""
        self._rows: dict[int, int] = {}
        self._coordinates = np.empty((0, 3), dtype=np.int64)
        self._voxels = np.empty((0, VOXELS, 4), dtype=np.float32)
        self._colours = np.empty((0, VOXELS, 4), dtype=np.uint8)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def coordinates(self) -> npt.NDArray[np.int64]:
        """Places (n, 3) of the blocks on the grid of blocks."""
        return self._coordinates[: len(self)]

    @property
    def voxels(self) -> Float32Array:
        """Sums (n, 512, 4) of the blocks' voxels."""
        return self._voxels[: len(self)]

    @property
    def colours(self) -> ByteArray:
        """Mean colours (n, 512, 4) of the blocks' voxels."""
        return self._colours[: len(self)]

    def row(self, coordinates: tuple[int, int, int]) -> int | None:
        """Row of the block at a place of the grid, or None."""
        return self._rows.get(int(_keys(np.array([coordinates]))[0]))

    def add(
        self, T_map_camera: FloatArray, camera: Camera, depth: Float32Array, sigma: Float32Array, picture: ByteArray
    ) -> None:
        """Add a depth image: depth and sigma (h, w) m, 0 where there is none; picture (h, w, 3), or (0, 0, 3)."""
        self._allocate(self._surface_cells(T_map_camera, camera, depth))
        self._integrate(T_map_camera, camera, depth, sigma, picture, 1.0)

    def remove(self, T_map_camera: FloatArray, camera: Camera, depth: Float32Array, sigma: Float32Array) -> None:
        """Take away what :meth:`add` added at the same pose; colours stay."""
        self._integrate(T_map_camera, camera, depth, sigma, np.empty((0, 0, 3), dtype=np.uint8), -1.0)

    def _integrate(
        self, T: FloatArray, camera: Camera, depth: Float32Array, sigma: Float32Array, picture: ByteArray, sign: float
    ) -> None:
        T_camera_map = invert_transform(T)
        blocks = self._visible(T_camera_map, camera, float(depth.max(initial=0.0)))
        view = DepthView(T_camera_map, _intrinsics(camera), depth, sigma, picture)
        size = self.config.voxel_size
        integrate(blocks, self._origins(), self._voxels, self._colours, size, self.truncation, view, sign)

    def _origins(self) -> FloatArray:
        return np.asarray(self.coordinates * self.block_size, dtype=np.float64)

    def _visible(self, T_camera_map: FloatArray, camera: Camera, farthest: float) -> npt.NDArray[np.int64]:
        """Rows of the blocks that the camera may see."""
        centres = transform_points(T_camera_map, self._origins() + 0.5 * self.block_size)
        radius = 0.5 * np.sqrt(3.0) * self.block_size
        x, y, z = centres.T
        seen = (z > -radius) & (z < farthest + radius + self.truncation)
        for along, focal, centre, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            for edge, side in ((-centre, 1.0), (size - centre, -1.0)):
                slope = edge / focal  # the side plane: along = slope * z
                seen &= side * (along - slope * z) / np.hypot(1.0, slope) > -radius
        return np.flatnonzero(seen)

    def _surface_cells(self, T: FloatArray, camera: Camera, depth: Float32Array) -> npt.NDArray[np.int64]:
        """Places (m, 3) of the blocks near the surfaces that a depth image shows."""
        cells = np.empty((3 * (depth.size // 4 + sum(depth.shape) + 1), 3), dtype=np.int64)
        recent = np.full((_RECENT, 3), _KEY_RANGE, dtype=np.int64)
        count = surface_blocks(T, _intrinsics(camera), depth, self.truncation, self.block_size, recent, cells)
        return cells[:count]

    def _allocate(self, cells: npt.NDArray[np.int64]) -> None:
        """Make the blocks at places (n, 3)."""
        keys, first = np.unique(_keys(cells), return_index=True)
        new = [(key, i) for key, i in zip(keys.tolist(), first.tolist(), strict=True) if key not in self._rows]
        room = self.config.max_blocks - len(self)
        self.refused_blocks += max(0, len(new) - room)
        new = new[: max(0, room)]
        self._make_room()
        for key, i in new:
            self._coordinates[len(self)] = cells[i]
            self._rows[key] = len(self)

    def _make_room(self) -> None:
        """Room for all blocks that there may be: the system gives memory to those alone that are written to."""
        if not len(self._voxels):
            most = self.config.max_blocks
            self._coordinates = np.zeros((most, 3), dtype=np.int64)
            self._voxels = np.zeros((most, VOXELS, 4), dtype=np.float32)
            self._colours = np.zeros((most, VOXELS, 4), dtype=np.uint8)


def _keys(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """One integer per block coordinate (n, 3)."""
    shifted = cells + _KEY_RANGE // 2
    if len(cells) and (shifted.min() < 0 or shifted.max() >= _KEY_RANGE):
        raise ValueError("the dense model would reach farther than its grid: is the pose finite and in metres?")
    return np.asarray((shifted[:, 0] * _KEY_RANGE + shifted[:, 1]) * _KEY_RANGE + shifted[:, 2])


def _intrinsics(camera: Camera) -> FloatArray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
