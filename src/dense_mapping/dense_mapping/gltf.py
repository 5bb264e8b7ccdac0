# SPDX-License-Identifier: Apache-2.0
"""Binary glTF whose surfaces are matt: without a material glTF means metal, black where nothing is mirrored."""

from __future__ import annotations

from typing import Any

import trimesh
from trimesh.exchange.gltf import export_glb

_MATT = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}


def matt_glb(scene: trimesh.Scene) -> bytes:
    """The scene as GLB; only front faces are drawn, so that one looks into rooms from outside."""
    return bytes(export_glb(scene, tree_postprocessor=_make_matt))  # type: ignore[no-untyped-call]


def _make_matt(tree: dict[str, Any]) -> None:
    tree["materials"] = [_MATT]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
