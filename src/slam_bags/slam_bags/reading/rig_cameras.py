# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one rig in a bag: each with topics below a name of its own, in one tree of frames.

    /front/stereo/left/image_raw   /back/stereo/left/image_raw      one rig, of the cameras "front" and "back",
    /imu                                                            and of what is no camera
    base_link -> front/stereo_left_optical_frame, back/stereo_left_optical_frame

Namespaces are cameras of one rig, not agents, where the frames of all their images differ and hang below one
``base_link`` that none of them has for itself, and none has a way, position or pressure of its own, nor more than one
the only IMUs. A ``rig.yaml`` (:mod:`slam_bags.reading.rig_file`) says so where the
topics are named otherwise.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

from slam_bags.reading.extrinsics import StaticTransform
from slam_core.frame_tree import FrameTree
from slam_core.rig_features import MOST_CAMERAS

RIG_ROLES = ("imu", "odometry", "position", "pressure", "scan", "ground_truth")
"""Roles of sensors that are no cameras: a rig has one of each."""
_OF_AGENTS = ("odometry", "position", "pressure", "ground_truth/pose")
"""Topics that a namespace has for itself if it is an agent, and a camera has not."""


@dataclass(frozen=True, eq=False)
class RigCameras:
    """Topics by role of each camera of a rig by its name, and static transforms; empty: as the bag has them."""

    topics: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    transforms: tuple[StaticTransform, ...] = ()


def rigs_of(
    frames_of: Mapping[str, Sequence[str]], tree: FrameTree, known: Collection[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Namespaces of the cameras of each rig, by the rig's namespace; an agent with one camera is a rig of itself.

    frames_of: frames of the images in each namespace. known: all topics of the bag.
    """
    siblings: dict[str, list[str]] = {}
    for namespace in sorted(frames_of):
        siblings.setdefault(namespace.rpartition("/")[0], []).append(namespace)
    rigs: dict[str, tuple[str, ...]] = {}
    for parent, names in siblings.items():
        is_rig = parent not in frames_of and not _are_agents(parent, names, known)
        if is_rig and _is_one_rig(parent, names, frames_of, tree):
            rigs[parent] = tuple(names)
        else:
            rigs |= {name: (name,) for name in names}
    return dict(sorted(rigs.items()))


def _is_one_rig(parent: str, names: Sequence[str], frames_of: Mapping[str, Sequence[str]], tree: FrameTree) -> bool:
    """True if the namespaces are cameras of one rig."""
    if not all(frames_of[name] for name in names) or shared_frame({name: frames_of[name] for name in names}):
        return False
    frames = {frame for name in names for frame in frames_of[name]}
    base = next((b for b in (f"{parent}/base_link".lstrip("/"), "base_link") if b in tree), "")
    if not 2 <= len(names) <= MOST_CAMERAS or not base:
        return False
    return not any(f"{name}/base_link" in tree for name in names) and frames <= tree.below(base).keys()


def _are_agents(parent: str, names: Sequence[str], known: Collection[str]) -> bool:
    """True if a namespace has topics for itself that one of several cameras has not."""
    has_imu = [name for name in names if f"/{name}/imu" in known]
    if len(has_imu) > 1 and f"/{parent}/imu".replace("//", "/") not in known:
        return True
    return any(f"/{name}/{topic}" in known for name in names for topic in _OF_AGENTS)


def shared_frame(frames_of: Mapping[str, Collection[str]]) -> str:
    """Names of two cameras whose images have one frame, and what to do, or ""."""
    for (one, frames), (other, others) in combinations(frames_of.items(), 2):
        if common := sorted(set(frames) & set(others)):
            return (
                f"cameras {one} and {other} have one frame, '{common[0]}', so that where each sits is not known: give "
                "the headers of each camera's infos and images a frame of its own"
            )
    return ""
