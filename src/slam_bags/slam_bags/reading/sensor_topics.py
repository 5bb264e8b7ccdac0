# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag by sensor: the nodes' own names below each agent's namespace, or names that a user gives.

A role is what a topic is for ("left", "depth", "imu", ...). The camera info of an image stands beside it, as
image_transport has it (``<camera>/camera_info``), unless its role ("left_info") is given.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from slam_bags.reading.rig_calibration import RigCalibration
from slam_bags.reading.rig_cameras import RIG_ROLES, RigCameras

_LEFT = ("stereo/left/image_raw", "stereo/left/image_rect", "stereo/left/image_raw/compressed")
_CANDIDATES = {
    "left": _LEFT,
    "right": tuple(name.replace("left", "right") for name in _LEFT),
    "range": ("tof/range/image_raw",),
    "depth": ("tof/depth/image_raw",),
    "amplitude": ("tof/amplitude/image_raw",),
    "intensity": ("tof/intensity/image_raw",),
    "color": ("tof/color/image_raw", "tof/color/image_raw/compressed"),
    "mask": ("mask",),
    "tof_mask": ("tof/mask",),
    "imu": ("imu",),
    "odometry": ("odometry",),
    "position": ("position",),
    "pressure": ("pressure",),
    "scan": ("scan",),
    "ground_truth": ("ground_truth/pose",),
}
_INFO_OF = {"left_info": ("left",), "right_info": ("right",), "tof_info": ("range", "depth")}
_CAMERAS = ("left", "range", "depth")

ROLES = (*_CANDIDATES, *_INFO_OF)


@dataclass(frozen=True)
class BagNames:
    """Names of a bag that differ from those of the nodes, and a calibration instead of its own.

    topics: by role. rig: those of several cameras of one rig. base_frame: the frame whose poses are wanted; "":
    ``base_link``, or where there is none the root above the camera in the tree of frames.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    base_frame: str = ""
    calibration: RigCalibration = field(default_factory=RigCalibration)
    rig: RigCameras = field(default_factory=RigCameras)


def parse_topics(assignments: Iterable[str]) -> dict[str, str]:
    """Topics by role, of texts like ``left=/camera/left/image_raw``.

    Raises
    ------
    ValueError
        If a text has another form, or its role is unknown.
    """
    topics = {}
    for text in assignments:
        role, _, topic = text.partition("=")
        if role not in ROLES or not topic:
            raise ValueError(f"topic '{text}' is not ROLE=TOPIC with a role of {', '.join(ROLES)}")
        topics[role] = topic if topic.startswith("/") else f"/{topic}"
    return topics


def find_agents(known: Collection[str], given: Mapping[str, str]) -> tuple[str, ...]:
    """Namespaces with a camera among the topics ``known``; one without a name if a camera's topic is ``given``."""
    if any(role in given for role in _CAMERAS):
        return ("",)
    names = [name for role in _CAMERAS for name in _CANDIDATES[role]]
    return tuple(sorted({t[1 : -len(n)].rstrip("/") for t in known for n in names if t.endswith(f"/{n}")}))


def topics_of(agent: str, known: Collection[str], given: Mapping[str, str]) -> dict[str, str]:
    """The topics of an agent's sensors by role; a role that the bag has no topic for is absent.

    So is a laser's scan beside a depth camera, whose scans are registered instead, and colours without a depth camera.

    Raises
    ------
    ValueError
        If a topic that is ``given`` is not among those ``known``, or is a laser's scan beside a depth camera or colours
        without one.
    """
    if missing := sorted(set(given.values()) - set(known)):
        raise ValueError(f"the bag has no topic {', '.join(missing)}; it has {', '.join(sorted(known)) or 'none'}")
    found = dict(given)
    for role, names in _CANDIDATES.items():
        present = [topic for topic in (join(agent, name) for name in names) if topic in known]
        if present and role not in given:
            found[role] = present[0]
    if "range" in found and "depth" in found:
        del found["depth" if "range" in given or "depth" not in given else "range"]
    if "scan" in given and {"range", "depth"} & found.keys():
        raise ValueError("a rig with a depth camera registers what that measures: leave the topic of 'scan' out")
    if {"range", "depth"} & found.keys():
        found.pop("scan", None)
    elif "color" in given:
        raise ValueError("'color' is beside a depth camera; a stereo camera in colour is given as 'left' and 'right'")
    else:
        found.pop("color", None)
    for role, images in _INFO_OF.items():
        beside = [topic for image in images if image in found for topic in _infos_beside(found[image])]
        if role not in given and beside:
            found[role] = next((topic for topic in beside if topic in known), beside[0])
    return found


def topics_on_rig(
    rig: str, cameras: Mapping[str, Mapping[str, str]], known: Collection[str], given: Mapping[str, str]
) -> tuple[dict[str, dict[str, str]], list[str]]:
    """Topics by role of each camera of a rig, the first with those of what is no camera, and the topics not used.

    What is no camera has its topic at the rig, or is of the first camera that has one. ``cameras``: as in their
    namespaces. Errors as of :func:`topics_of`.
    """
    own = topics_of(rig, known, {role: topic for role, topic in given.items() if role in RIG_ROLES})
    of_rig = {role: topic for role, topic in own.items() if role in RIG_ROLES}
    of_cameras: set[str] = set()
    for topics in cameras.values():
        beside = {role: topic for role, topic in topics.items() if role in RIG_ROLES}
        of_rig, of_cameras = beside | of_rig, of_cameras | set(beside.values())
    if any({"range", "depth"} & topics.keys() for topics in cameras.values()):
        of_rig.pop("scan", None)
    found = {
        name: {role: topic for role, topic in topics.items() if role not in RIG_ROLES}
        for name, topics in cameras.items()
    }
    found[next(iter(cameras))] |= of_rig
    return found, sorted(of_cameras - set(of_rig.values()))


def is_rectified(image_topic: str) -> bool:
    """True if the images of a topic are rectified, by their name: ``image_rect``, ``image_rect_raw``, ..."""
    return "rect" in _without_transport(image_topic).rsplit("/", 1)[-1]


def nodes_name(agent: str, role: str, topic: str, measurement: str) -> str:
    """Name that the nodes give the topic of a role; ``measurement`` is what the depth camera measures.

    Raises
    ------
    ValueError
        For compressed rectified images: the nodes take those as they come, not compressed.
    """
    if role in ("left", "right"):
        compressed = topic.endswith("/compressed")
        if compressed and is_rectified(topic):
            raise ValueError(
                f"{topic}: the nodes take rectified images that are not compressed; slam run takes them all"
            )
        kind = "image_rect" if is_rectified(topic) else "image_raw"
        return join(agent, f"stereo/{role}/{kind}{'/compressed' if compressed else ''}")
    if role == "tof_info":
        return join(agent, "tof/camera_info")
    if role.endswith("_info"):
        return join(agent, f"stereo/{role.removesuffix('_info')}/camera_info")
    return join(agent, _CANDIDATES[measurement if role == "depth" else role][0])


def join(agent: str, name: str) -> str:
    """Full name of a topic below the namespace of an agent."""
    return f"/{agent}/{name}" if agent else f"/{name}"


def other_cameras(used: Collection[str], types: Mapping[str, str]) -> list[str]:
    """Image topics (of topics with their ``types``) of cameras of which no topic is used; not what nodes publish."""
    images = [topic for topic, kind in types.items() if kind.rpartition("/")[2] in ("Image", "CompressedImage")]
    known = {_camera(topic) for topic in used} | {_camera(_camera(topic)) for topic in used} - {""}
    raw = [t for t in images if _without_transport(t).rpartition("/")[2].startswith("image_r")]
    return sorted({_without_transport(t) for t in raw if _camera(t) not in known and _camera(_camera(t)) not in known})


def _camera(image_topic: str) -> str:
    return _without_transport(image_topic).rpartition("/")[0]


def _infos_beside(image_topic: str) -> list[str]:
    """A ToF camera has several images and one info, a level higher."""
    camera, _, _ = _without_transport(image_topic).rpartition("/")
    return [f"{camera}/camera_info", f"{camera.rpartition('/')[0]}/camera_info"]


def _without_transport(image_topic: str) -> str:
    for ending in ("/compressed", "/compressedDepth"):
        image_topic = image_topic.removesuffix(ending)
    return image_topic
