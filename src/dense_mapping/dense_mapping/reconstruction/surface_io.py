# SPDX-License-Identifier: Apache-2.0
"""A surface as files: PLY with normals, colours and sigma (plyfile), GLB for every viewer (trimesh)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
import trimesh

from dense_mapping.reconstruction.gltf import matt_glb
from dense_mapping.reconstruction.surface import Surface
from slam_core.storage.files import atomic_path


def write_points(path: Path, surface: Surface) -> None:
    """Write the vertices as a binary PLY: x y z, nx ny nz, red green blue, sigma (m)."""
    with atomic_path(path) as temporary:
        plyfile.PlyData([_vertex_element(surface)], byte_order="<").write(str(temporary))


def write_mesh(path: Path, surface: Surface) -> None:
    """Write vertices, as :func:`write_points`, and triangles as a binary PLY."""
    faces = np.empty(len(surface.faces), dtype=[("vertex_indices", "<i4", (3,))])
    ply = plyfile.PlyData([_vertex_element(surface), plyfile.PlyElement.describe(faces, "face")], byte_order="<")
    # plyfile writes lists face by face, in Python; triangles all have one size.
    rows = np.empty(len(surface.faces), dtype=[("size", "u1"), ("corners", "<i4", (3,))])
    rows["size"], rows["corners"] = 3, surface.faces
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(f"{ply.header}\n".encode("ascii"))
        file.write(ply["vertex"].data.tobytes())
        file.write(rows.tobytes())


def write_glb(path: Path, surface: Surface) -> None:
    """Write a binary glTF, whose Y axis is up (the map's Z), with normals and colours."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    normals = surface.normals @ turn.T if len(surface) else None
    mesh = trimesh.Trimesh(
        surface.points @ turn.T, surface.faces, vertex_normals=normals, vertex_colors=surface.colours, process=False
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(matt_glb(trimesh.Scene(mesh)))


def read_mesh(path: Path) -> Surface:
    """The surface of a PLY file by :func:`write_mesh` or :func:`write_points`.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    try:
        ply = plyfile.PlyData.read(str(path))
        vertex = ply["vertex"]
        points, normals, colours = (
            np.stack([vertex[name] for name in names], axis=1)
            for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
        )
        sigma = np.asarray(vertex["sigma"])
        has_faces = "face" in ply
        faces = np.stack(ply["face"]["vertex_indices"]) if has_faces and len(ply["face"]) else np.empty((0, 3))
    except (plyfile.PlyParseError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no dense model of this program: {error}") from error
    return Surface(points, normals, colours, sigma, faces.astype(np.int32))


def _vertex_element(surface: Surface) -> plyfile.PlyElement:
    names = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    names += [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("sigma", "<f4")]
    out = np.empty(len(surface), dtype=names)
    for axis in range(3):
        out["xyz"[axis]] = surface.points[:, axis]
        out[("nx", "ny", "nz")[axis]] = surface.normals[:, axis]
        out[("red", "green", "blue")[axis]] = surface.colours[:, axis]
    out["sigma"] = surface.sigma
    return plyfile.PlyElement.describe(out, "vertex")
