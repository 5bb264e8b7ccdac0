# SPDX-License-Identifier: Apache-2.0
"""Points as PLY files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import plyfile

from slam_core.storage.files import atomic_path
from slam_core.types import Float32Array


def write_ply(path: Path, points: Float32Array, scalars: Mapping[str, npt.NDArray[np.generic]] | None = None) -> None:
    """Write points (n, 3) m as a binary PLY of float32 values; scalars: further properties by name, (n,) each."""
    columns = dict(zip("xyz", points.T, strict=True)) | dict(scalars or {})
    vertices = np.empty(len(points), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    with atomic_path(path) as temporary:
        plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def is_ply(path: Path) -> bool:
    """True if a file begins as a PLY does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) in (b"ply\n", b"ply\r")
