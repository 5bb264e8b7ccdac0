# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one rig in a bag: each with topics below a name of its own, in one tree of frames.

    /front/stereo/left/image_raw   /back/stereo/left/image_raw      one rig, of the cameras "front" and "back",
    /imu                                                            and of what is no camera
    base_link -> front/stereo_left_optical_frame, back/stereo_left_optical_frame

Namespaces are cameras of one rig, not agents, where the frames of all their images differ and hang below one
``base_link`` that none of them has for itself. A ``rig.yaml`` (:mod:`slam_bags.reading.rig_file`) says so where the
topics are named otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slam_bags.reading.extrinsics import StaticTransform
from slam_core.frame_tree import FrameTree
from slam_core.rig_features import MOST_CAMERAS

RIG_ROLES = ("imu", "odometry", "position", "scan", "ground_truth")
"""Roles of sensors that are no cameras: a rig has one of each."""


@dataclass(frozen=True, eq=False)
class RigCameras:
    """Topics by role of each camera of a rig by its name, and static transforms; empty: as the bag has them."""

    topics: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    transforms: tuple[StaticTransform, ...] = ()


def rigs_of(frames_of: Mapping[str, Sequence[str]], tree: FrameTree) -> dict[str, tuple[str, ...]]:
    """Namespaces of the cameras of each rig, by the rig's namespace; an agent with one camera is a rig of itself.

    frames_of: frames of the images in each namespace.
    """
    siblings: dict[str, list[str]] = {}
    for namespace in sorted(frames_of):
        siblings.setdefault(namespace.rpartition("/")[0], []).append(namespace)
    rigs: dict[str, tuple[str, ...]] = {}
    for parent, names in siblings.items():
        if parent not in frames_of and _is_one_rig(parent, names, frames_of, tree):
            rigs[parent] = tuple(names)
        else:
            rigs |= {name: (name,) for name in names}
    return dict(sorted(rigs.items()))


def _is_one_rig(parent: str, names: Sequence[str], frames_of: Mapping[str, Sequence[str]], tree: FrameTree) -> bool:
    """True if the namespaces are cameras of one rig."""
    frames = [frame for name in names for frame in frames_of[name]]
    base = next((b for b in (f"{parent}/base_link".lstrip("/"), "base_link") if b in tree), "")
    if not 2 <= len(names) <= MOST_CAMERAS or not base or len(set(frames)) < len(frames):
        return False
    return not any(f"{name}/base_link" in tree for name in names) and set(frames) <= tree.below(base).keys()
