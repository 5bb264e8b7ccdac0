# SPDX-License-Identifier: Apache-2.0
"""Point clouds as PLY files and on voxel grids."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slam_core.files import atomic_path
from slam_core.types import ByteArray, Float32Array


def write_ply(
    path: Path,
    points: Float32Array,
    grey: ByteArray | None = None,
    scalars: Mapping[str, npt.NDArray[np.generic]] | None = None,
) -> None:
    """Write points (n, 3) m as a binary PLY of float32 coordinates.

    grey: values (n,) to be its colour. scalars: further properties by name, (n,) each, as float32.
    """
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    names = {"<f4": "float", "u1": "uchar"}
    if grey is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    scalars = scalars or {}
    fields += [(name, "<f4") for name in scalars]
    vertices = np.empty(len(points), dtype=fields)
    for name, values in scalars.items():
        vertices[name] = values
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    if grey is not None:
        for name in ("red", "green", "blue"):
            vertices[name] = grey
    properties = "".join(f"property {names[kind]} {name}\n" for name, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + vertices.tobytes())


def is_ply(path: Path) -> bool:
    """True if a file begins as a PLY does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) in (b"ply\n", b"ply\r")


def voxel_mean(
    points: Float32Array, voxel_size: float, values: npt.NDArray[np.float32]
) -> tuple[Float32Array, Float32Array]:
    """Mean point (m, 3) and mean value (m,) of each occupied voxel; non-finite points are dropped."""
    finite = np.isfinite(points).all(axis=1)
    points, values = points[finite], values[finite]
    if len(points) == 0:
        return np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.float32)
    cells = np.floor(points / voxel_size).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    sums = [np.bincount(inverse, weights=column) for column in (*points.T, values)]
    means = np.column_stack(sums) / counts[:, None]
    return means[:, :3].astype(np.float32), means[:, 3].astype(np.float32)
