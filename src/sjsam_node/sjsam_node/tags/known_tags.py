# SPDX-License-Identifier: Apache-2.0
"""Tags of which it is known where in the building they are: a YAML file, and the submap that says so to the map.

    size: 0.16                 # edge of the black square, m, unless a tag has its own
    sigma: 0.01                # standard deviation of a position, m
    sigma_angle: 0.01          # and of a rotation, rad
    tags:
      - {id: 3, position: [0.0, 2.5, 1.4], quaternion: [0.5, 0.5, 0.5, 0.5]}    # x, y, z, w
      - {id: 8, position: [12.0, 2.5, 1.4], quaternion: [0.5, 0.5, 0.5, 0.5], size: 0.2, sigma: 0.05}

The tags' corners are one submap of an agent of its own whose start is the origin of the building's frame. Closures by
tags tie other submaps to it as to any other, it defines the frame of all that is tied to it, and a tag that is not
where the file says is found as a moved one is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sjsam_node.graph.map_graph import BUILDING
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, make_transform, rotation_from_quaternion, skew
from slam_core.storage.files import read_yaml
from slam_core.tags import CORNERS, LARGEST_TAG, corner_ids, square
from slam_core.types import ORIGIN_SIGMA, PoseEstimate, Submap

_SURE = 2**15
"""Sightings of a known tag."""
_PRINT_SIGMA = 5e-4
"""Of each corner by itself: paper is not quite flat (m)."""
_TOP, _OWN = {"size", "sigma", "sigma_angle", "tags"}, {"id", "position", "quaternion", "size", "sigma", "sigma_angle"}


@dataclass(frozen=True)
class KnownTagsConfig(Config):
    """Tags of which it is known where they are."""

    known: str = parameter("", "YAML file of tags whose poses in the building are known; the map is in that frame then")

    def known_tags(self) -> tuple[KnownTag, ...]:
        """The tags of the file; none without a file.

        Raises
        ------
        ValueError
            With the file and what is wrong in it.
        """
        return read_known_tags(Path(self.known).expanduser()) if self.known else ()


@dataclass(frozen=True, eq=False)
class KnownTag:
    """A tag at ``T`` = T_building_tag (4, 4), with its edge and standard deviations of position, m, and angle, rad."""

    number: int
    T: FloatArray
    size: float
    sigma: float
    sigma_angle: float


def read_known_tags(path: Path) -> tuple[KnownTag, ...]:
    """The tags of a file, by number; ValueError with the file and what is wrong in it."""
    try:
        content = read_yaml(path)
    except OSError as error:
        raise ValueError(f"{path}: known tags cannot be read: {error.strerror or error}") from error
    if not isinstance(content, Mapping) or not isinstance(content.get("tags"), list) or not content["tags"]:
        raise ValueError(f"{path}: a file of known tags is a mapping with a list 'tags'")
    if unknown := set(content) - _TOP:
        raise ValueError(f"{path}: unknown {sorted(map(str, unknown))}, known: {', '.join(sorted(_TOP))}")
    common = {key: content[key] for key in _TOP - {"tags"} if key in content}
    try:
        tags = [_tag({"sigma": 0.01, "sigma_angle": 0.01} | common | dict(row)) for row in content["tags"]]
    except (TypeError, KeyError, ValueError) as error:
        missing = f"a tag lacks {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: {missing}") from error
    numbers = [tag.number for tag in tags]
    if twice := {n for n in numbers if numbers.count(n) > 1}:
        raise ValueError(f"{path}: tags {sorted(twice)} stand there twice")
    return tuple(sorted(tags, key=lambda tag: tag.number))


def _tag(row: dict[str, Any]) -> KnownTag:
    if unknown := set(row) - _OWN:
        raise ValueError(f"a tag has an unknown {sorted(map(str, unknown))}, known: {', '.join(sorted(_OWN))}")
    number = row["id"]
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < LARGEST_TAG:
        raise ValueError(f"a tag's id is a whole number from 0, got {number!r}")
    position, quaternion = np.array(row["position"], dtype=float), np.array(row["quaternion"], dtype=float)
    if position.shape != (3,) or quaternion.shape != (4,):
        raise ValueError(f"tag {number}: position has three numbers and quaternion four")
    lengths = {key: float(row[key]) for key in ("size", "sigma", "sigma_angle")}
    for key, value in lengths.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"tag {number}: {key} must be positive, got {value}")
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise ValueError(f"tag {number}: its pose must be finite numbers")
    return KnownTag(number, make_transform(rotation_from_quaternion(quaternion), position), **lengths)


def building_submap(tags: tuple[KnownTag, ...], columns: int) -> Submap:
    """Known tags as a submap that starts at the building's origin, with descriptors of ``columns`` zeros."""
    n = CORNERS * len(tags)
    landmarks, covariance = np.empty((n, 3)), ORIGIN_SIGMA**2 * np.eye(6 + 3 * n)
    for k, tag in enumerate(tags):
        arms = square(tag.size) @ tag.T[:3, :3].T
        landmarks[CORNERS * k : CORNERS * (k + 1)] = arms + tag.T[:3, 3]
        J = np.concatenate([np.broadcast_to(np.eye(3), (CORNERS, 3, 3)), -skew(arms)], axis=2).reshape(-1, 6)
        P = J @ np.diag([tag.sigma**2] * 3 + [tag.sigma_angle**2] * 3) @ J.T
        rows = slice(6 + 3 * CORNERS * k, 6 + 3 * CORNERS * (k + 1))
        covariance[rows, rows] = P + _PRINT_SIGMA**2 * np.eye(3 * CORNERS)
    path = (PoseEstimate(0, np.eye(4), ORIGIN_SIGMA**2 * np.eye(6)),) * 2
    return Submap(
        agent=BUILDING, index=0, start_stamp_ns=0, end_stamp_ns=0, end_pose=np.eye(4), landmarks=landmarks,
        covariance=covariance, landmark_ids=corner_ids([t.number for t in tags]),
        sightings=np.full(n, _SURE, np.int32), descriptors=np.zeros((n, columns), np.float32), path=path,
        follows_previous=False,
    )  # fmt: skip
