# SPDX-License-Identifier: Apache-2.0
"""Checks that what a stored map says can be true: types, sizes, references, finite numbers, rigid poses, covariances.

A map is a file that somebody else may have touched. Everything is checked before anything is made of it; each check
raises ``ValueError`` that names what is wrong.
"""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np

from slam_core.geometry import is_rigid_transform
from slam_core.types import AnyArray

Arrays = dict[str, AnyArray]

_KINDS = "fiub"
_LINKS = ("links", "pending", "refused")


def arrays_of(data: bytes) -> Arrays:
    """The arrays of an uncompressed npz archive; none may claim to be larger than its bytes.

    Raises
    ------
    ValueError
        If the archive is not one that NumPy wrote, is compressed, or holds anything but numbers.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            infos = archive.infolist()
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise ValueError("the arrays are compressed, which a map's never are")
            if sum(info.file_size for info in infos) > len(data):
                raise ValueError(f"the arrays claim to be larger than their {len(data)} bytes")
            return {info.filename.removesuffix(".npy"): _array(info.filename, archive.read(info)) for info in infos}
    except zipfile.BadZipFile as error:
        raise ValueError(f"the arrays are not an npz archive: {error}") from error


def _array(name: str, data: bytes) -> AnyArray:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{name} has the unknown npy version {version}")
    shape, fortran, kind = read(stream)
    if kind.kind not in _KINDS or kind.itemsize * math.prod(shape) != len(data) - stream.tell():
        raise ValueError(f"{name} claims {shape} of {kind}, which its {len(data)} bytes are not")
    values = np.frombuffer(data, kind, offset=stream.tell()).copy()
    return values.reshape(shape, order="F" if fortran else "C")


def check_manifest(manifest: dict[str, Any]) -> None:
    """Types and ranges of all that a manifest says."""
    name = manifest["arrays"]
    if not isinstance(name, str) or "/" in name or "\\" in name or not name.endswith(".npz"):
        raise ValueError(f"arrays must name a file of the folder, got {name!r}")
    if not _is_int(manifest.get("bytes", 0)):
        raise ValueError(f"bytes must be the size of the arrays, got {manifest['bytes']!r}")
    if not isinstance(manifest.get("is_out_of_order", False), bool):
        raise ValueError(f"is_out_of_order must be true or false, got {manifest['is_out_of_order']!r}")
    for record in manifest["records"]:
        agent, index, session, start, follows = record
        if not (isinstance(agent, str) and isinstance(follows, bool) and all(map(_is_int, (index, session, start)))):
            raise ValueError(f"a record must be [agent, index, session, start, follows], got {record}")
    keys = [tuple(record[:3]) for record in manifest["records"]]
    if len(set(keys)) != len(keys):
        raise ValueError("two submaps have the same agent, session and index")
    for mark in manifest["marks"]:
        text, node, *point = mark
        if not (isinstance(text, str) and _is_int(node) and len(point) == 3 and all(map(_is_finite, point))):
            raise ValueError(f"a mark must be [name, node, x, y, z], got {mark}")


def check_arrays(manifest: dict[str, Any], arrays: Arrays) -> None:
    """Shapes, ranges and numbers of all arrays, against each other and the manifest."""
    records, nodes = manifest["records"], len(arrays["poses"])
    landmarks = [len(arrays[f"submap_{i}/landmarks"]) for i in range(len(records))]
    _require_shape(arrays, "poses", (nodes, 4, 4))
    _require_shape(arrays, "points", (sum(landmarks), 3))
    _require_shape(arrays, "component_of", (nodes,))
    for name in ("ties", "redundant", "doubt"):
        _require_shape(arrays, name, (len(records),))
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    if (arrays["doubt"] < 1.0).any():
        raise ValueError("doubt holds variance factors below one")
    _require_rigid("poses", arrays["poses"])
    _require_index("component_of", arrays["component_of"], nodes)
    _require_index("a mark's node", np.array([mark[1] for mark in manifest["marks"]], dtype=np.int64), nodes)
    _check_skeleton([record[3] for record in records], nodes)
    for i in range(len(records)):
        _check_submap(arrays, f"submap_{i}/", landmarks[i])
    for name in _LINKS:
        _check_links(arrays, name, landmarks)
    pairs = arrays["compared/pairs"]
    _require_shape(arrays, "compared/pairs", (len(pairs), 2))
    _require_shape(arrays, "compared/middles", (len(pairs), 3))
    _require_index("compared/pairs", pairs, len(records))


def _check_skeleton(starts: list[int], nodes: int) -> None:
    """Every record starts at a node before it, or at a new one, and ends at a new one."""
    made = 0
    for start in starts:
        if not 0 <= start <= made:
            raise ValueError(f"a submap starts at node {start} of {made}")
        made += 1 if start < made else 2
    if made != nodes:
        raise ValueError(f"{len(starts)} submaps make {made} nodes, the map has {nodes} poses")


def _check_submap(arrays: Arrays, prefix: str, n: int) -> None:
    own = {
        "stamps": (2,), "end_pose": (4, 4), "landmarks": (n, 3), "covariance": (6 + 3 * n, 6 + 3 * n),
        "landmark_ids": (n,), "sightings": (n,),
    }  # fmt: skip
    for name, shape in own.items():
        _require_shape(arrays, prefix + name, shape)
    descriptors, poses = arrays[f"{prefix}descriptors"], len(arrays[f"{prefix}path_stamps"])
    _require_shape(arrays, f"{prefix}descriptors", (n, *descriptors.shape[1:2]))
    _require_shape(arrays, f"{prefix}path_poses", (poses, 4, 4))
    _require_shape(arrays, f"{prefix}path_covariances", (poses, 6, 6))
    _require_rigid(f"{prefix}path_poses", arrays[f"{prefix}path_poses"])
    _require_rigid(f"{prefix}end_pose", arrays[f"{prefix}end_pose"][None])
    _require_positive(f"{prefix}covariance", arrays[f"{prefix}covariance"])


def _check_links(arrays: Arrays, name: str, landmarks: list[int]) -> None:
    ends, pairs = arrays[f"{name}/ends"], arrays[f"{name}/pairs"]
    n = len(ends)
    for part, shape in (("ends", (n, 4)), ("pairs", (len(pairs), 2)), ("error", (n,)), ("T", (n, 4, 4)),
                        ("covariance", (n, 6, 6))):  # fmt: skip
        _require_shape(arrays, f"{name}/{part}", shape)
    _require_index(f"{name}/ends", ends[:, :2], len(landmarks))
    if (ends[:, 2] < 0).any() or ends[:, 2].sum() != len(pairs):
        raise ValueError(f"{name}: the links name {ends[:, 2].sum()} pairs, there are {len(pairs)}")
    limits = np.repeat(np.array(landmarks, dtype=np.int64)[ends[:, :2]], ends[:, 2], axis=0)
    if ((pairs < 0) | (pairs >= limits)).any():
        raise ValueError(f"{name}: a pair names a landmark that its submap does not have")
    _require_rigid(f"{name}/T", arrays[f"{name}/T"])
    _require_positive(f"{name}/covariance", arrays[f"{name}/covariance"])


def _require_shape(arrays: Arrays, name: str, shape: tuple[int, ...]) -> None:
    if arrays[name].shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {arrays[name].shape}")


def _require_index(name: str, values: AnyArray, count: int) -> None:
    if values.dtype.kind != "i" or ((values < 0) | (values >= count)).any():
        raise ValueError(f"{name} must be whole numbers from 0 to {count - 1}")


def _require_rigid(name: str, poses: AnyArray) -> None:
    if bad := [i for i, T in enumerate(poses) if not is_rigid_transform(T)]:
        raise ValueError(f"{name}: number {bad[0]} is not a rigid transform")


def _require_positive(name: str, covariance: AnyArray) -> None:
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{name} is not positive definite") from error


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
