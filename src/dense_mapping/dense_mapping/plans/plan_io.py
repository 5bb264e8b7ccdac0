# SPDX-License-Identifier: Apache-2.0
"""Floor plans as files of Nav2's map_server: an image (PGM) and a YAML file that says where it lies.

The image's first row is the plan's last: Y points up in the picture. Of the trinary mode's pixels, 254 is free, 0 is
occupied and 205 unknown; ``free_thresh`` is 0.196, below the 50/255 of the unknown ones: with the 0.25 of Nav2's own
saver its loader takes them for free.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from slam_core.geometry import FloatArray, euler_from_rotation, make_transform, rotation_from_euler
from slam_core.storage.files import atomic_path, atomic_text, read_yaml

_PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196


def plan_names(count: int) -> list[str]:
    """Names of the files of so many storeys, from the lowest: ``floor_plan.yaml``, or ``floor_plan_0.yaml`` ..."""
    return [f"floor_plan_{number}.yaml" for number in range(count)] if count > 1 else ["floor_plan.yaml"][:count]


def write_plan(path: Path, plan: FloorPlan) -> None:
    """Write ``path`` (YAML) and beside it the image, ``path`` with the suffix .pgm.

    ``origin`` is x, y, yaw as Nav2 has it; the full pose T_map_plan, for maps that do not lie level, stands beside it
    under ``plan_pose``, which map_server does not read.
    """
    image = np.full(plan.cells.shape, _PIXELS[UNKNOWN], dtype=np.uint8)
    for value, pixel in _PIXELS.items():
        image[plan.cells == value] = pixel
    with atomic_path(path.with_suffix(".pgm")) as temporary:
        rows, columns = plan.cells.shape
        header = f"P5\n{columns} {rows}\n255\n".encode("ascii")
        temporary.write_bytes(header + np.ascontiguousarray(image[::-1]).tobytes())
    x, y, z = map(float, plan.T_map_plan[:3, 3])
    yaw = float(euler_from_rotation(plan.T_map_plan[:3, :3]).ravel()[0])
    content = {
        "image": path.with_suffix(".pgm").name, "mode": "trinary", "resolution": plan.resolution,
        "origin": [x, y, yaw], "negate": 0, "occupied_thresh": _OCCUPIED_THRESHOLD, "free_thresh": _FREE_THRESHOLD,
        "plan_pose": plan.T_map_plan.tolist(), "floor_height": z,
    }  # fmt: skip
    atomic_text(path, yaml.safe_dump(content, sort_keys=False))


def read_plan(path: Path) -> FloorPlan:
    """The plan of a YAML file for map_server, ours or another's, by the rules of its trinary mode.

    Raises
    ------
    ValueError
        If it is no such file or its image cannot be read.
    """
    try:
        content = read_yaml(path)
        image = _read_image(path.parent / content["image"])
        resolution, (x, y, yaw) = float(content["resolution"]), content["origin"]
        darkness = np.asarray((image if content["negate"] else 255.0 - image) / 255.0)
        occupied, free = float(content["occupied_thresh"]), float(content["free_thresh"])
        pose = make_transform(rotation_from_euler(yaw), np.array([x, y, 0.0]))
        pose = np.array(content.get("plan_pose", pose), dtype=np.float64)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is no map of map_server: {error}") from error
    cells = np.full(darkness.shape, UNKNOWN, dtype=np.int8)
    cells[darkness <= free] = FREE
    cells[darkness >= occupied] = OCCUPIED
    return FloorPlan(np.ascontiguousarray(cells[::-1]), resolution, pose)


def _read_image(path: Path) -> FloatArray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"no image at {path}")
    return image.astype(np.float64)
