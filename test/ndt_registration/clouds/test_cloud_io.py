# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ndt_registration.clouds.cloud_io import read_cloud
from ndt_registration.clouds.lzf import lzf_decompress
from slam_core.geometry import FloatArray

POINTS = np.array([[1.0, -2.0, 3.5], [0.25, 7.0, -1.0], [np.nan, np.nan, np.nan], [4.0, 5.0, 6.0]])


def pcd_header(encoding: str) -> bytes:
    lines = ["# .PCD v0.7", "VERSION 0.7", "FIELDS intensity x y z", "SIZE 2 4 4 4", "TYPE U F F F", "COUNT 1 1 1 1"]
    lines += ["WIDTH 4", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", "POINTS 4", f"DATA {encoding}\n"]
    return "\n".join(lines).encode()


def literal_lzf(data: bytes) -> bytes:
    """LZF without any back reference: runs of at most 32 bytes as they are."""
    return b"".join(bytes([len(run) - 1]) + run for run in (data[i : i + 32] for i in range(0, len(data), 32)))


def records(order: str = "<") -> bytes:
    out = np.zeros(4, dtype=[("i", order + "u2"), ("x", order + "f4"), ("y", order + "f4"), ("z", order + "f4")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        out[axis] = column
    return out.tobytes()


def pcd(encoding: str) -> bytes:
    if encoding == "ascii":
        return pcd_header("ascii") + "\n".join(f"7 {x} {y} {z}" for x, y, z in POINTS).encode()
    if encoding == "binary":
        return pcd_header("binary") + records()
    fields = np.zeros(4, "<u2").tobytes() + POINTS.T.astype("<f4").tobytes()
    packed = literal_lzf(fields)
    return pcd_header("binary_compressed") + np.array([len(packed), len(fields)], "<u4").tobytes() + packed


def ply(encoding: str) -> bytes:
    header = f"ply\nformat {encoding} 1.0\ncomment c\nelement vertex 4\nproperty ushort i\nproperty float x\n"
    header += "property float y\nproperty float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        return header.encode() + "\n".join(f"7 {x} {y} {z}" for x, y, z in POINTS).encode()
    return header.encode() + records("<" if "little" in encoding else ">")


def vtk(encoding: str) -> bytes:
    header = f"# vtk DataFile Version 3.0\nclouds\n{encoding}\nDATASET POLYDATA\nPOINTS 4 float\n".encode()
    body = (
        POINTS.astype(">f4").tobytes()
        if encoding == "BINARY"
        else "\n".join(" ".join(map(str, p)) for p in POINTS).encode()
    )
    return header + body + b"\nVERTICES 0 0\n"


FILES = {
    "a.pcd": pcd("ascii"), "b.pcd": pcd("binary"), "c.pcd": pcd("binary_compressed"), "a.ply": ply("ascii"),
    "b.ply": ply("binary_little_endian"), "c.ply": ply("binary_big_endian"), "a.vtk": vtk("ASCII"), "b.vtk":
    vtk("BINARY"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_every_format_gives_the_points_back(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(FILES[name])
    np.testing.assert_array_equal(read_cloud(tmp_path / name), POINTS)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9])
def test_truncated_files_are_refused_by_name(tmp_path: Path, name: str, share: float) -> None:
    body = FILES[name][:-30] if name.endswith("vtk") else FILES[name]
    (tmp_path / name).write_bytes(body[: int(share * len(body))])
    with pytest.raises(ValueError, match=name):
        read_cloud(tmp_path / name)


def test_unknown_kind_and_fields_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"v 1 2 3")
    with pytest.raises(ValueError, match="unknown kind"):
        read_cloud(tmp_path / "a.obj")
    (tmp_path / "a.pcd").write_bytes(FILES["a.pcd"].replace(b"intensity x y z", b"intensity r s t"))
    with pytest.raises(ValueError, match="no fields x and y"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("name", ["a.pcd", "b.pcd", "c.pcd", "a.ply", "b.ply"])
def test_files_without_z_are_in_the_plane(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(FILES[name].replace(b"x y z", b"x y w").replace(b"float z", b"float w"))
    np.testing.assert_array_equal(read_cloud(tmp_path / name), POINTS[:, :2])


@pytest.mark.parametrize(
    ("text", "points"),
    [("x,y\n1,2\n3.5,-4\n", [[1, 2], [3.5, -4]]), ("# scan\n1 2 3\n\n4 5 nan\n", [[1, 2, 3], [4, 5, np.nan]])],
)
def test_lines_of_numbers(tmp_path: Path, text: str, points: list[list[float]]) -> None:
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv"), points)


@pytest.mark.parametrize("text", ["1 2\n3 4 5\n", "x y\n", "1\n2\n", "1 2\n3 four\n"])
def test_other_lines_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=r"a\.txt"):
        read_cloud(tmp_path / "a.txt")


SCAN = "{angle_min: 0.0, angle_increment: 1.5707963267948966, range_min: 0.1, range_max: 9.0, ranges: [2.0, .inf, 3.0]}"


def test_a_laser_scan_as_ros_prints_it(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(f"{SCAN}\n---\n")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.yaml"), [[2, 0], [np.nan, np.nan], [-3, 0]], atol=1e-6)
    for text, reason in ((SCAN.replace("ranges", "rays"), "ranges"), ("[1, 2]", "no message"), ("{: ", "YAML")):
        (tmp_path / "a.yaml").write_text(text)
        with pytest.raises(ValueError, match=reason):
            read_cloud(tmp_path / "a.yaml")


def test_back_references_of_lzf() -> None:
    packed = np.array([1, 65, 66, (4 << 5) | 0, 1, 0, 67], np.uint8)
    assert lzf_decompress(packed, 9).tobytes() == b"ABABABABC"
    with pytest.raises(ValueError, match="damaged"):
        lzf_decompress(packed, 12)


def test_public_clouds(data_dir: Path) -> None:
    expected = {
        "cloud_pcl_pairwise/pairwise/capture0001.pcd": 307200,
        "cloud_small_gicp/data/source.ply": 69792,
        "cloud_libpointmatcher/icp_tutorial/cloud_0.vtk": 36674,
    }
    for name, count in expected.items():
        cloud: FloatArray = read_cloud(data_dir / name)
        assert cloud.shape == (count, 3)
        assert np.nanmax(np.abs(cloud)) < 200.0
