# SPDX-License-Identifier: Apache-2.0
"""``rig.yaml``: the cameras of one rig, by the topics of each.

cameras:
  front: {left: /cam1/infra1/image_rect_raw, right: /cam1/infra2/image_rect_raw}
  back: {depth: /cam2/depth/image_rect_raw}
transforms:                       # those that the bag or the driver does not have: parent child x y z qx qy qz qw
  - base_link cam2_depth_optical_frame -0.1 0 0 0.5 0.5 -0.5 -0.5
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slam_bags.reading.extrinsics import StaticTransform
from slam_bags.reading.rig_cameras import RigCameras
from slam_bags.reading.sensor_topics import parse_topics
from slam_core.rig_features import MOST_CAMERAS
from slam_core.storage.files import read_yaml

_CAMERA_ROLES = {"left", "range", "depth"}
"""Roles one of which every camera has."""


def read_rig_cameras(path: Path) -> RigCameras:
    """The cameras that a ``rig.yaml`` lists.

    Raises
    ------
    ValueError
        If the file cannot be read, holds anything else, or a role or transform is none.
    """
    document = read_yaml(path)
    if not isinstance(document, Mapping) or set(document) - {"cameras", "transforms"}:
        raise ValueError(f"{path} is no rig.yaml: it may hold 'cameras' and 'transforms'")
    cameras = document.get("cameras") or {}
    if not isinstance(cameras, Mapping) or not all(isinstance(own, Mapping) for own in cameras.values()):
        raise ValueError(f"{path}: 'cameras' is a mapping of names to topics by role")
    if not 1 <= len(cameras) <= MOST_CAMERAS:
        raise ValueError(f"{path}: a rig has one to {MOST_CAMERAS} cameras, got {len(cameras)}")
    try:
        topics = {str(name): parse_topics(f"{role}={t}" for role, t in own.items()) for name, own in cameras.items()}
        transforms = tuple(StaticTransform.parse(str(text)) for text in document.get("transforms") or ())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if wrong := [name for name in topics if not name.isidentifier()]:
        raise ValueError(f"{path}: '{wrong[0]}' is no name for a camera: letters, digits and _")
    if blind := [name for name, own in topics.items() if not _CAMERA_ROLES & own.keys()]:
        raise ValueError(f"{path}: camera '{blind[0]}' has no topic of {', '.join(sorted(_CAMERA_ROLES))}")
    return RigCameras(topics, transforms)
