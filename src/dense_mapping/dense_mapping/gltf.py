# SPDX-License-Identifier: Apache-2.0
"""Binary glTF whose surfaces are matt: without a material glTF means metal, black where nothing is mirrored."""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb

from dense_mapping.surface import Surface
from slam_core.types import AnyArray

_MATT: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
_UNLIT = "KHR_materials_unlit"
_FLOAT, _BYTE, _INTEGER = 5126, 5121, 5125
"""Component types."""
_VERTICES, _INDICES = 34962, 34963
"""Targets of buffer views."""


def surface_glb(surface: Surface) -> bytes:
    """The surface as GLB with normals and colours; glTF's Y axis is up, the map's Z.

    Written here: trimesh first makes copies of everything in 64 bits.
    """
    opaque = np.full((len(surface), 4), 255, dtype=np.uint8)
    opaque[:, :3] = surface.colours
    parts = [
        _Part("POSITION", _y_up(surface.points), _FLOAT, "VEC3"),
        _Part("NORMAL", _y_up(surface.normals), _FLOAT, "VEC3"),
        _Part("COLOR_0", opaque, _BYTE, "VEC4"),
        _Part("", surface.faces.astype("<u4").reshape(-1), _INTEGER, "SCALAR"),
    ]
    tree: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{}]}
    if len(surface.faces):
        tree = tree | _mesh(parts)
    return _packed(tree, b"".join(part.values.tobytes() for part in parts))


class _Part(NamedTuple):
    """An array of a mesh: its name among the attributes, "" of the triangles, and how glTF calls its elements."""

    attribute: str
    values: AnyArray
    component: int
    kind: str


def _y_up(vectors: AnyArray) -> AnyArray:
    turned = np.empty(vectors.shape, dtype="<f4")
    turned[:, 0], turned[:, 1], turned[:, 2] = vectors[:, 0], vectors[:, 2], -vectors[:, 1]
    return turned


def _mesh(parts: list[_Part]) -> dict[str, Any]:
    """The part of a glTF tree that says where a mesh lies in the buffer."""
    ends = np.cumsum([part.values.nbytes for part in parts]).tolist()
    views = [
        {
            "buffer": 0,
            "byteOffset": end - part.values.nbytes,
            "byteLength": part.values.nbytes,
            "target": _VERTICES if part.attribute else _INDICES,
        }
        for part, end in zip(parts, ends, strict=True)
    ]
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": part.component, "count": len(part.values), "type": part.kind}
        for k, part in enumerate(parts)
    ]
    accessors[0] |= {"min": parts[0].values.min(axis=0).tolist(), "max": parts[0].values.max(axis=0).tolist()}
    accessors[2]["normalized"] = True
    attributes = {part.attribute: k for k, part in enumerate(parts) if part.attribute}
    return {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(parts) - 1, "material": 0}]}],
        "materials": [_MATT],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": ends[-1]}],
    }


def _packed(tree: dict[str, Any], buffer: bytes) -> bytes:
    """Tree and buffer as one file; all parts are whole numbers of four bytes."""
    text = json.dumps(tree, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if buffer:
        chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unlit_glb(scene: trimesh.Scene) -> bytes:
    """A scene as GLB in the colours that its vertices have, whatever the lamps of a viewer are."""
    return bytes(export_glb(scene, tree_postprocessor=_set_unlit))  # type: ignore[no-untyped-call]


def _set_unlit(tree: dict[str, Any]) -> None:
    tree["extensionsUsed"] = [_UNLIT]
    tree["materials"] = [_MATT | {"extensions": {_UNLIT: {}}}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
