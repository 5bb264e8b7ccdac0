# SPDX-License-Identifier: Apache-2.0
"""Binary glTF whose surfaces are matt: without a material glTF means metal, black where nothing is mirrored."""

from __future__ import annotations

from functools import partial
from typing import Any

import trimesh
from trimesh.exchange.gltf import export_glb

_MATT: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
_UNLIT = "KHR_materials_unlit"


def matt_glb(scene: trimesh.Scene, *, lit: bool = True) -> bytes:
    """The scene as GLB; only front faces are drawn, so that one looks into rooms from outside.

    Not ``lit``: in the colours that the vertices have, whatever the lamps of a viewer are.
    """
    return bytes(export_glb(scene, tree_postprocessor=partial(_set_material, lit=lit)))  # type: ignore[no-untyped-call]


def _set_material(tree: dict[str, Any], lit: bool) -> None:
    if not lit:
        tree["extensionsUsed"] = [_UNLIT]
    tree["materials"] = [_MATT if lit else _MATT | {"extensions": {_UNLIT: {}}}]
    for mesh in tree.get("meshes", ()):  # a run that saw nothing has none
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
