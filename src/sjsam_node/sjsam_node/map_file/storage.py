# SPDX-License-Identifier: Apache-2.0
"""A joined map on disk: a folder with ``manifest.json`` and one file of arrays, exact to the last bit.

The manifest names the format, its version, the file of arrays, its size and digest, and carries a digest of itself. A
map that is there is replaced by one rename of the manifest, so that at any moment, also after a power cut, the folder
holds the old map or the new one. Foreign, newer or damaged folders are refused with a clear line: everything is read
and checked before anything is made of it (:mod:`sjsam_node.map_file.map_validation`).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.graph.marks import Mark, Marks
from sjsam_node.loop_closure.near_pairs import Compared
from sjsam_node.map_file.map_validation import arrays_of, check_arrays, check_manifest
from sjsam_node.positions.stored_readings import stored_waiting, waiting_arrays
from sjsam_node.smoothing.state import EstimateState
from sjsam_node.smoothing.stored import estimate_arrays, stored_state
from slam_core.storage.files import MOST_BYTES, atomic_path, digest, naming, read_bytes, read_json, remove
from slam_core.types import AnyArray, PoseEstimate, PositionReading, Submap

FORMAT, VERSION = "indoor-slam-map", 6
_MANIFEST = "manifest.json"
_MANIFEST_PART = f"{_MANIFEST}.part"
_ARRAYS_PART = "arrays.part.npz"
_ARRAYS = re.compile(r"arrays(-[0-9a-f]{16}|\.part)?\.npz")
"""Names of the files of arrays that versions of this program wrote."""
Arrays = dict[str, AnyArray]


@dataclass(frozen=True, eq=False)
class StoredMap:
    """All that a map needs to go on as if it had never been put away.

    pending, refused: closures that wait for another that says the same, and for more that speaks for them; compared:
    pairs of submaps compared where they were near (see :mod:`sjsam_node.loop_closure.near_pairs`); is_out_of_order:
    submaps or landmarks came after it was settled, so that the settled map is joined anew; waiting: positions by
    record, which are not tied to the fixed frame.
    """

    state: EstimateState
    pending: list[Link]
    refused: list[Link]
    compared: Compared
    marks: Marks
    is_out_of_order: bool = False
    waiting: Mapping[int, tuple[PositionReading, ...]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PackedMap:
    """A map as it is written; it shares nothing with the map that changes."""

    manifest: dict[str, Any]
    arrays: Arrays


def write(folder: Path, stored: StoredMap) -> None:
    """Write a map to ``folder``; a map that is there is replaced, ValueError if there is anything else."""
    write_packed(folder, pack(stored))


def pack(stored: StoredMap) -> PackedMap:
    """A copy of a map, to be written by another thread while the map goes on."""
    graph = stored.state.graph
    arrays = estimate_arrays(stored.state)
    arrays.update(_link_arrays("links", graph.links))
    arrays.update(_link_arrays("pending", stored.pending))
    arrays.update(_link_arrays("refused", stored.refused))
    arrays["compared/pairs"], arrays["compared/middles"] = stored.compared.pairs, stored.compared.seen.copy()
    arrays.update(waiting_arrays(stored.waiting))
    for i, record in enumerate(graph.records):
        arrays.update({f"submap_{i}/{name}": value for name, value in _submap_arrays(record.submap).items()})
    manifest = {
        "format": FORMAT, "version": VERSION, "submaps": len(graph.records),
        "agents": sorted({r.submap.agent for r in graph.records}),
        "records": [
            [s.agent, s.index, s.session, r.start, s.follows_previous] for r in graph.records for s in [r.submap]
        ],
        "marks": [[m.name, m.node, *m.point.tolist()] for m in stored.marks.marks],
    }  # fmt: skip
    if stored.is_out_of_order:
        manifest["is_out_of_order"] = True
    return PackedMap(manifest, arrays)


def write_packed(folder: Path, packed: PackedMap) -> None:
    """Write a packed map, as :func:`write` does."""
    if not is_map(folder):
        with atomic_path(folder) as temporary:
            temporary.mkdir()
            manifest = packed.manifest | _write_arrays(temporary, packed.arrays)
            _write_synced(temporary / _MANIFEST, _text(manifest))
        return
    try:
        with naming(folder):
            manifest = packed.manifest | _write_arrays(folder, packed.arrays)
            _write_synced(folder / _MANIFEST_PART, _text(manifest))
            os.replace(folder / _MANIFEST_PART, folder / _MANIFEST)
    finally:  # nothing half-written stays, on a disk that is full
        for part in (_ARRAYS_PART, _MANIFEST_PART):
            remove(folder / part)
    for old in folder.iterdir():
        if _ARRAYS.fullmatch(old.name) and old.name != manifest["arrays"]:
            old.unlink()


def _write_arrays(folder: Path, arrays: Arrays) -> dict[str, str | int]:
    """Name, size and digest of the file that is written, straight to disk: a map fills much of the memory already."""
    part = folder / _ARRAYS_PART
    with part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    sha256, size = digest(part), part.stat().st_size
    name = f"arrays-{sha256[:16]}.npz"
    os.replace(part, folder / name)
    return {"arrays": name, "bytes": size, "sha256": sha256}


def _text(manifest: dict[str, Any]) -> bytes:
    return (json.dumps(manifest | {"manifest_sha256": _digest(manifest)}, indent=1) + "\n").encode()


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def read(folder: Path) -> StoredMap:
    """The map of a folder that :func:`write` made.

    Raises
    ------
    ValueError
        If the folder is missing, foreign, of another version or damaged.
    """
    manifest = _manifest(folder)
    try:
        check_manifest(manifest)
        data = read_bytes(folder / manifest["arrays"], min(manifest.get("bytes", MOST_BYTES), MOST_BYTES))
        if hashlib.sha256(data).hexdigest() != manifest["sha256"]:
            raise ValueError(f"{manifest['arrays']} does not match its digest")
        arrays = arrays_of(data)
        check_arrays(manifest, arrays)
        return _stored(manifest, arrays)
    except OSError as error:
        raise ValueError(f"{folder}: the map is damaged: its arrays cannot be read: {error}") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{folder}: the map is damaged: {error}") from error


def _stored(manifest: dict[str, Any], arrays: Arrays) -> StoredMap:
    state = stored_state(_submaps(manifest["records"], arrays), _links("links", arrays), arrays)
    marks = Marks([Mark(name, node, np.array(point, dtype=np.float64)) for name, node, *point in manifest["marks"]])
    pending, refused = _links("pending", arrays), _links("refused", arrays)
    compared = Compared.of(arrays["compared/pairs"], arrays["compared/middles"])
    is_out_of_order = manifest.get("is_out_of_order", False)
    return StoredMap(state, pending, refused, compared, marks, is_out_of_order, stored_waiting(arrays))


def _digest(manifest: dict[str, Any]) -> str:
    """Digest of all that a manifest says, but its digest."""
    said = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def is_map(folder: Path) -> bool:
    """True if a folder holds a map of any version, and nothing else."""
    try:
        content = read_json(folder / _MANIFEST)
    except (OSError, ValueError):
        return False
    is_ours = isinstance(content, dict) and content.get("format") == FORMAT
    return is_ours and all(p.name in (_MANIFEST, _MANIFEST_PART) or _ARRAYS.fullmatch(p.name) for p in folder.iterdir())


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest = read_json(folder / _MANIFEST)
    except (OSError, ValueError) as error:
        raise ValueError(f"{folder}: not a map: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{folder}: not a map of this program (format {FORMAT!r} expected)")
    if manifest.get("version") != VERSION:
        raise ValueError(f"{folder}: map version {manifest.get('version')} cannot be read, only version {VERSION}")
    try:
        is_whole = manifest.get("manifest_sha256") == _digest(manifest)
    except RecursionError:  # read by a parser that goes deeper than the writer
        is_whole = False
    if not is_whole:
        raise ValueError(f"{folder}: the map is damaged: {_MANIFEST} does not match its digest")
    return manifest


def _link_arrays(name: str, links: Sequence[Link]) -> Arrays:
    pairs = [link.pairs for link in links]
    return {
        f"{name}/ends": np.array(
            [[k.first, k.second, len(k.pairs), k.is_closure] for k in links], dtype=np.int64
        ).reshape(-1, 4),
        f"{name}/pairs": np.concatenate(pairs) if pairs else np.empty((0, 2), dtype=np.int64),
        f"{name}/error": np.array([link.error for link in links], dtype=np.float64),
        f"{name}/T": np.array([link.T for link in links]).reshape(-1, 4, 4),
        f"{name}/covariance": np.array([link.covariance for link in links]).reshape(-1, 6, 6),
    }


def _links(name: str, arrays: Arrays) -> list[Link]:
    ends = arrays[f"{name}/ends"]
    pairs = np.split(arrays[f"{name}/pairs"], np.cumsum(ends[:, 2])[:-1]) if len(ends) else []
    return [
        Link(
            int(first),
            int(second),
            pairs[i],
            arrays[f"{name}/T"][i],
            arrays[f"{name}/covariance"][i],
            bool(closure),
            float(arrays[f"{name}/error"][i]),
        )
        for i, (first, second, _, closure) in enumerate(ends)
    ]


def _submap_arrays(submap: Submap) -> Arrays:
    return {
        "stamps": np.array([submap.start_stamp_ns, submap.end_stamp_ns], dtype=np.int64),
        "end_pose": submap.end_pose, "landmarks": submap.landmarks, "covariance": submap.covariance,
        "landmark_ids": submap.landmark_ids, "sightings": submap.sightings, "descriptors": submap.descriptors,
        "path_stamps": np.array([p.stamp_ns for p in submap.path], dtype=np.int64),
        "path_poses": np.array([p.T for p in submap.path]).reshape(-1, 4, 4),
        "path_covariances": np.array([p.covariance for p in submap.path]).reshape(-1, 6, 6),
    }  # fmt: skip


def _submap(agent: str, index: int, session: int, follows: bool, arrays: Arrays) -> Submap:
    path = zip(arrays["path_stamps"].tolist(), arrays["path_poses"], arrays["path_covariances"], strict=True)
    return Submap(
        agent, index, int(arrays["stamps"][0]), int(arrays["stamps"][1]), arrays["end_pose"], arrays["landmarks"],
        arrays["covariance"], arrays["landmark_ids"], arrays["sightings"], arrays["descriptors"],
        tuple(PoseEstimate(stamp, T, P) for stamp, T, P in path), follows, session,
    )  # fmt: skip


def _submaps(records: list[list[Any]], arrays: Arrays) -> Iterator[tuple[int, Submap]]:
    """Yield every submap with the node that it starts at."""
    for i, (agent, index, session, start, follows) in enumerate(records):
        prefix = f"submap_{i}/"
        own = {name[len(prefix) :]: value for name, value in arrays.items() if name.startswith(prefix)}
        yield start, _submap(agent, index, session, follows, own)
