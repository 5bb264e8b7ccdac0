# SPDX-License-Identifier: Apache-2.0
"""camera_info YAML files as ROS tools read them (camera_calibration_parsers), with uncertainties in extra keys.

ROS readers look up the keys they know, so ``standard_deviations`` travels along unseen by them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import FloatArray
from slam_core.storage.files import atomic_text, read_yaml

COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of distortion coefficients of each model that a ROS file may hold."""

_ALIASES = {"radtan": "plumb_bob", "radial-tangential": "plumb_bob", "fisheye": "equidistant", "": "plumb_bob"}


@dataclass(frozen=True, eq=False)
class CameraInfoFile:
    """One camera_info YAML file.

    ``standard_deviations``: by parameter name (fx, fy, cx, cy in px; k1, k2, p1, ... without unit); empty if unknown.
    """

    info: CameraInfo
    camera_name: str = "camera"
    standard_deviations: Mapping[str, float] = field(default_factory=dict)

    def write(self, path: str | Path) -> None:
        """Write the file; it appears complete or not at all."""
        text = yaml.safe_dump(self._document(), sort_keys=False, default_flow_style=None, width=110)
        atomic_text(Path(path), text)

    def _document(self) -> dict[str, Any]:
        camera = self.info.camera
        # ROS has no model without distortion: plumb_bob with zeros says the same.
        model = "plumb_bob" if camera.distortion_model == "none" else camera.distortion_model
        distortion = np.zeros(COEFFICIENTS[model])
        distortion[: len(camera.distortion)] = camera.distortion
        document: dict[str, Any] = {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": self.camera_name,
            "camera_matrix": _matrix(camera.K),
            "distortion_model": model,
            "distortion_coefficients": _matrix(distortion[None]),
            "rectification_matrix": _matrix(self.info.R),
            "projection_matrix": _matrix(self.info.P),
        }
        if self.standard_deviations:
            document["standard_deviations"] = {k: float(v) for k, v in self.standard_deviations.items()}
        return document


def read_camera_info(path: str | Path) -> CameraInfoFile:
    """Read a camera_info YAML file.

    Raises
    ------
    ValueError
        If the file is no YAML mapping, lacks a key or holds a matrix of the wrong size; the message names file and key.
    OSError
        If the file cannot be opened.
    """
    document = read_yaml(Path(path))
    if not isinstance(document, dict):
        raise ValueError(f"{path} is not a camera_info YAML file: expected a mapping of names to values")
    try:
        return _from_document(document)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _from_document(document: Mapping[str, Any]) -> CameraInfoFile:
    model = str(_required(document, "distortion_model"))
    model = _ALIASES.get(model, model)
    K = _read_matrix(document, "camera_matrix", (3, 3))
    distortion = tuple(_read_matrix(document, "distortion_coefficients", None).ravel().tolist())
    if model == "plumb_bob" and len(distortion) == 8:
        model = "rational_polynomial"
    if model in COEFFICIENTS and len(distortion) > COEFFICIENTS[model]:
        raise ValueError(f"{model} has {COEFFICIENTS[model]} distortion coefficients, got {len(distortion)}")
    if model != "equidistant" and not any(distortion):
        model, distortion = "none", ()
    width, height = int(_required(document, "image_width")), int(_required(document, "image_height"))
    camera = Camera(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), model, distortion)
    R = _read_matrix(document, "rectification_matrix", (3, 3)) if "rectification_matrix" in document else np.eye(3)
    P = _read_matrix(document, "projection_matrix", (3, 4)) if "projection_matrix" in document else np.zeros((3, 4))
    deviations = {str(k): float(v) for k, v in dict(document.get("standard_deviations") or {}).items()}
    return CameraInfoFile(CameraInfo(camera, R, P), str(document.get("camera_name", "camera")), deviations)


def _matrix(values: FloatArray) -> dict[str, Any]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": [float(v) for v in values.ravel()]}


def _required(document: Mapping[str, Any], key: str) -> Any:
    if key not in document:
        raise ValueError(f"missing key '{key}'")
    return document[key]


def _read_matrix(document: Mapping[str, Any], key: str, shape: tuple[int, int] | None) -> FloatArray:
    entry = _required(document, key)
    data = entry.get("data") if isinstance(entry, dict) else entry
    try:
        values = np.array(data, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(f"'{key}' must hold numbers, got {data!r}") from error
    if shape is not None and values.size != shape[0] * shape[1]:
        raise ValueError(f"'{key}' must hold {shape[0]} x {shape[1]} numbers, got {values.size}")
    return values.reshape(shape) if shape is not None else values
