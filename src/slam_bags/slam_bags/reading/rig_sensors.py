# SPDX-License-Identifier: Apache-2.0
"""Sensors found in the namespaces of a bag, as those of the cameras of a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from slam_bags.reading.readings import AgentSensors
from slam_bags.reading.rig_cameras import RigCameras, shared_frame
from slam_bags.reading.sensor_topics import BagNames, topics_on_rig


def heard_cameras(rig: RigCameras, counts: Mapping[str, int]) -> tuple[tuple[str, ...], list[str]]:
    """Cameras that a file lists, without those that never sent a message, and a warning of these; all if none did.

    counts: messages by topic; a topic that is absent makes its camera one that is asked for, not one that is silent.
    """
    heard = [name for name, topics in rig.topics.items() if any(counts.get(topic, 1) for topic in topics.values())]
    silent = [name for name in rig.topics if name not in heard]
    if not heard or not silent:
        return tuple(rig.topics), []
    return tuple(heard), [f"no message of camera {', '.join(silent)}: it is left out"]


def on_rig(
    rig: str, cameras: Mapping[str, AgentSensors], counts: Mapping[str, int], names: BagNames
) -> tuple[dict[str, AgentSensors], list[str]]:
    """The sensors of namespaces as those of a rig, whose frame is yet to be found, and warnings of topics not used.

    What is no camera is its first camera's.

    Raises
    ------
    ValueError
        If two cameras have one frame, or a topic is given that the bag has not.
    """
    if len(cameras) == 1 and not names.rig.topics:
        return {name: replace(own, rig=rig) for name, own in cameras.items()}, []
    if shared := shared_frame({name: {own.left_frame, own.tof_frame} - {""} for name, own in cameras.items()}):
        raise ValueError(shared)
    own_topics = {name: own.topics for name, own in cameras.items()}
    topics, unused = topics_on_rig(rig, own_topics, counts, names.topics)
    placed = {
        name: replace(own, topics=topics[name], rig=rig, camera=name.rpartition("/")[2])
        for name, own in cameras.items()
    }
    return placed, [f"not used, for a rig has one of each: {', '.join(unused)} (--topic)"] * bool(unused)
