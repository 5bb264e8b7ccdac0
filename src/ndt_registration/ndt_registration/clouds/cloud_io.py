# SPDX-License-Identifier: Apache-2.0
"""Point clouds from files: PCD (ascii, binary, binary_compressed), PLY, legacy VTK (ascii and binary) and text.

Files without z hold clouds in the plane. A laser scan is the YAML of a sensor_msgs/LaserScan, as ``ros2 topic echo
--once --full-length`` prints it.
"""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import plyfile
import yaml

from ndt_registration.clouds.lzf import lzf_decompress
from slam_core.geometry import FloatArray
from slam_core.messages import points_from_scan
from slam_core.storage.files import read_bytes

VTK_TYPES = {"float": ">f4", "double": ">f8"}


def read_cloud(path: Path) -> FloatArray:
    """Points (n, 3) m, in the plane (n, 2), of a file of one of ``READERS``, NaN points included.

    Raises
    ------
    ValueError
        If the suffix is unknown or the file is empty, truncated or contradicts itself.
    OSError
        If it cannot be read.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: unknown kind of cloud '{path.suffix}', known: {', '.join(READERS)}")
    content = read_bytes(path)
    if not content.strip():
        raise ValueError(f"{path}: the file is empty")
    try:
        return reader(content)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a valid {path.suffix[1:]} cloud: {error}") from error


def read_pcd(content: bytes) -> FloatArray:
    """Points of a PCD file (version 0.7)."""
    header, body = _pcd_header(content)
    names = header["FIELDS"]
    count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    axes = _axes(names)
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    kinds = [f"<{_pcd_kind(t)}{s}" for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
    encoding = header["DATA"][0]
    if encoding == "ascii":
        first = np.concatenate([[0], np.cumsum(counts)])
        return _ascii_columns(body, count, int(first[-1]), [int(first[names.index(axis)]) for axis in axes])
    layout = np.dtype([(f"{n}{i}", k, (c,)) for i, (n, k, c) in enumerate(zip(names, kinds, counts, strict=True))])
    if encoding == "binary":
        records = np.frombuffer(_exactly(body, count * layout.itemsize), dtype=layout)
        return np.column_stack([records[f"{a}{names.index(a)}"][:, 0] for a in axes]).astype(np.float64)
    if encoding == "binary_compressed":
        return _pcd_compressed(body, count, names, layout)
    raise ValueError(f"unknown DATA '{encoding}'")


def _pcd_header(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = content.find(b"\n", position)
        if end < 0:
            raise ValueError("the header has no DATA line")
        words = content[position:end].decode("ascii").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, content[position:]


def _pcd_kind(letter: str) -> str:
    return {"F": "f", "I": "i", "U": "u"}[letter]


def _pcd_compressed(body: bytes, count: int, names: list[str], layout: np.dtype[np.void]) -> FloatArray:
    """The fields one after the other, compressed as a whole by LZF."""
    packed, size = (int(v) for v in np.frombuffer(_exactly(body, 8), "<u4"))
    if size != count * layout.itemsize:
        raise ValueError(f"{size} bytes of points announced, {count * layout.itemsize} needed")
    data = lzf_decompress(np.frombuffer(_exactly(body[8:], packed), np.uint8), size)
    columns = []
    for axis in _axes(names):
        field = layout.fields[f"{axis}{names.index(axis)}"] if layout.fields else None
        assert field is not None
        start = field[1] * count
        columns.append(np.frombuffer(data[start : start + count * field[0].itemsize].tobytes(), field[0].base))
    return np.column_stack(columns).astype(np.float64)


def read_ply(content: bytes) -> FloatArray:
    """Vertices of a PLY file, ascii or binary of either byte order."""
    try:
        vertices = plyfile.PlyData.read(io.BytesIO(content))["vertex"]
    except plyfile.PlyParseError as error:
        raise ValueError(str(error)) from error
    axes = _axes([p.name for p in vertices.properties])
    return np.column_stack([vertices[axis] for axis in axes]).astype(np.float64)


def read_vtk(content: bytes) -> FloatArray:
    """Points of a legacy VTK file (POLYDATA or UNSTRUCTURED_GRID), ascii or big-endian binary."""
    if not content.startswith(b"# vtk DataFile"):
        raise ValueError("no legacy VTK header")
    encoding = content.split(b"\n", 3)[2].strip().upper()
    start = content.index(b"POINTS ")
    end = content.index(b"\n", start)
    _, number, kind = content[start:end].decode("ascii").split()
    count, body = int(number), content[end + 1 :]
    if encoding == b"BINARY":
        dtype = np.dtype(VTK_TYPES[kind])
        return np.frombuffer(_exactly(body, 3 * count * dtype.itemsize), dtype).reshape(-1, 3).astype(np.float64)
    return _ascii_columns(body, count, 3, [0, 1, 2])


def read_text(content: bytes) -> FloatArray:
    """Points of lines of two or three numbers, apart by commas or blanks, after a line of names or none."""
    lines = content.decode("utf-8").replace(",", " ").splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if rows and not _is_number(rows[0][0]):
        rows = rows[1:]
    if not rows or {len(row) for row in rows} not in ({2}, {3}):
        raise ValueError("its lines must all have two numbers, x and y, or all three")
    return np.array(rows, dtype=np.float64)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_laser_scan(content: bytes) -> FloatArray:
    """Points (n, 2) of a sensor_msgs/LaserScan as YAML; a second document, as echo ends with, is left aside."""
    try:
        values = next(yaml.safe_load_all(content))
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {error}") from error
    if not isinstance(values, dict):
        raise ValueError("it holds no message")
    names = ("ranges", "angle_min", "angle_increment", "range_min", "range_max")
    if missing := [name for name in names if name not in values]:
        raise ValueError(f"a LaserScan has {', '.join(missing)}")
    return points_from_scan(SimpleNamespace(**{name: values[name] for name in names})).astype(np.float64)


def _ascii_columns(body: bytes, rows: int, width: int, columns: list[int]) -> FloatArray:
    words = body.split(maxsplit=rows * width)[: rows * width]
    if len(words) < rows * width:
        raise ValueError(f"{rows * width} numbers announced, {len(words)} found")
    table = np.array(words, dtype="S").astype(np.float64).reshape(rows, width) if words else np.empty((0, width))
    return table[:, columns]


def _axes(names: list[str]) -> str:
    """The coordinates that a file has."""
    if not {"x", "y"} <= set(names):
        raise ValueError(f"no fields x and y among {', '.join(names)}")
    return "xyz" if "z" in names else "xy"


def _exactly(body: bytes, size: int) -> bytes:
    if len(body) < size:
        raise ValueError(f"{size} bytes of points announced, {len(body)} found")
    return body[:size]


READERS = {
    ".pcd": read_pcd, ".ply": read_ply, ".vtk": read_vtk, ".csv": read_text, ".txt": read_text, ".xyz": read_text,
    ".yaml": read_laser_scan,
}  # fmt: skip
"""Reader of the content of a file, by its suffix."""
