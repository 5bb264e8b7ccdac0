# SPDX-License-Identifier: Apache-2.0
"""The dense model and the paths as a page that turns, drawn by the three.js that trimesh brings; it asks no network."""

from __future__ import annotations

import base64

import numpy as np
import trimesh
from trimesh.viewer.notebook import scene_to_html

from dense_mapping.reconstruction.decimation import at_most
from dense_mapping.reconstruction.gltf import matt_glb
from dense_mapping.reconstruction.surface import Surface
from slam_core.geometry import FloatArray, make_transform
from slam_core.types import ByteArray
from slam_viewer.report.figures import COLOURS
from slam_viewer.results import RunResult

_MOST_FACES = 120_000
"""As many as make some four megabytes."""
_LIGHT = np.array([0.4, -0.7, 1.0])
_Y_UP: FloatArray = make_transform(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""The map's Z axis is up, that of three.js is Y."""


def scene_page(result: RunResult) -> str | None:
    """A complete HTML page, seen first from above and aside; None for a run without a dense model."""
    if not len(result.dense.faces):
        return None
    surface = at_most(result.dense, _MOST_FACES)
    mesh = trimesh.Trimesh(surface.points, surface.faces, vertex_colors=_shaded(surface), process=False)
    scene = trimesh.Scene(mesh)
    for agent, colour in zip(result.agents, COLOURS * len(result.agents), strict=False):
        if len(agent.trajectory) > 1:
            scene.add_geometry(_path(agent.trajectory.poses[:, :3, 3], colour))
    scene.apply_transform(_Y_UP)  # type: ignore[no-untyped-call]
    low, high = np.percentile(surface.points @ _Y_UP[:3, :3].T, [2, 98], axis=0)
    scene.camera_transform = _view(low, high)
    return _page(scene)


def _page(scene: trimesh.Scene) -> str:
    """The viewer's page of another scene with ours in its place: its own export has no material, which means metal."""
    other = trimesh.Scene(trimesh.creation.box())
    page: str = scene_to_html(other)
    data = other.export(file_type="glb")  # type: ignore[no-untyped-call]
    before, found, after = page.partition(base64.b64encode(data).decode("ascii"))
    assert found, "the page holds the scene as base64"
    return before + base64.b64encode(matt_glb(scene, lit=False)).decode("ascii") + after


def _shaded(surface: Surface) -> ByteArray:
    """Colours as if light came from above and aside, so that shape shows where there is no texture."""
    light = _LIGHT / np.linalg.norm(_LIGHT)
    brightness = 0.78 + 0.22 * (surface.normals @ light)
    colours = (55.0 + 0.75 * surface.colours.astype(np.float32)) * brightness[:, None]
    return np.asarray(np.clip(colours, 0, 235), dtype=np.uint8)


def _path(points: FloatArray, colour: str) -> trimesh.path.Path3D:
    line = trimesh.load_path(np.stack([points[:-1], points[1:]], axis=1))
    rgba = [int(colour[i : i + 2], 16) for i in (1, 3, 5)] + [255]
    line.colors = np.tile(np.array(rgba, dtype=np.uint8), (len(line.entities), 1))
    return line  # type: ignore[no-any-return]


def _view(low: FloatArray, high: FloatArray) -> FloatArray:
    """Pose (4, 4) of a camera, looking along its -Z, from above and aside at a box, m; Y is up."""
    middle = (low + high) / 2
    distance = 0.75 * float(np.linalg.norm(high - low)) + 1.0
    back = np.array([-0.25, 0.8, 0.55])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return make_transform(np.column_stack([right, np.cross(back, right), back]), middle + distance * back)
