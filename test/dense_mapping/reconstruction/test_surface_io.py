# SPDX-License-Identifier: Apache-2.0
"""Files of a surface: read back by us, and by another program."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from dense_mapping.reconstruction.surface import Surface
from dense_mapping.reconstruction.surface_io import read_mesh, write_glb, write_mesh, write_points


@pytest.fixture
def tile() -> Surface:
    """A square metre of floor, a different colour and sigma at each corner."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]], dtype=np.uint8)
    sigma = np.float32([0.01, 0.02, 0.03, 0.04])
    return Surface(points, normals, colours, sigma, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def test_a_mesh_comes_back_as_it_was(tile, tmp_path):
    write_mesh(tmp_path / "mesh.ply", tile)
    back = read_mesh(tmp_path / "mesh.ply")
    for name in ("points", "normals", "colours", "sigma", "faces"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tile, name))


def test_the_surface_of_a_glb_is_matt(tile, tmp_path):
    """Without a material glTF means metal, which is black where a viewer has no surroundings to mirror."""
    write_glb(tmp_path / "mesh.glb", tile)
    data = (tmp_path / "mesh.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (primitive,) = tree["meshes"][0]["primitives"]
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0.0
    assert "COLOR_0" in primitive["attributes"]


def test_points_have_no_faces(tile, tmp_path):
    write_points(tmp_path / "map.ply", tile)
    assert len(read_mesh(tmp_path / "map.ply").faces) == 0


def test_another_program_reads_the_ply_and_the_glb(tile, tmp_path):
    write_mesh(tmp_path / "mesh.ply", tile)
    write_glb(tmp_path / "mesh.glb", tile)
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert ply.area == pytest.approx(1.0)
    np.testing.assert_array_equal(ply.visual.vertex_colors[:, :3], tile.colours)
    glb = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    assert glb.area == pytest.approx(1.0)
    np.testing.assert_allclose(glb.face_normals, [[0, 1, 0]] * 2, atol=1e-6)


def test_an_empty_surface_makes_files_too(tmp_path):
    for write, name in ((write_points, "map.ply"), (write_mesh, "mesh.ply"), (write_glb, "mesh.glb")):
        write(tmp_path / name, Surface.empty())
        assert (tmp_path / name).stat().st_size > 0
    assert len(read_mesh(tmp_path / "mesh.ply")) == 0


def test_a_foreign_file_is_refused_by_name(tmp_path):
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with pytest.raises(ValueError, match=r"mesh\.ply is no dense model"):
        read_mesh(tmp_path / "mesh.ply")
