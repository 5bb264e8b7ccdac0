# SPDX-License-Identifier: Apache-2.0
"""``result.mcap``: the topics and transforms of the nodes, for Foxglove, RViz and evo.

map -> odom is the one of the finished map, so that the trajectory shown is the smoothed one. What does not change in
time (the finished map, paths, static transforms) stands at the beginning, so that it is seen wherever one looks. All
frames hang together: the ground truth's by the rigid motion that fits it to the first agent's trajectory.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dense_mapping.reconstruction.surface_cloud import cloud_of
from sjsam_node.map_messages import graph_message, marks_message
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes, typestore
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.evaluation import associate
from slam_core.geometry import FloatArray, invert_transform
from slam_core.messages import (
    cloud_message,
    compressed_image_message,
    ellipsoid_markers,
    features_messages,
    header_message,
    landmark_cloud,
    occupancy_message,
    odometry_message,
    path_message,
    pose_stamped_message,
    pose_with_covariance_message,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from slam_viewer.results import AgentResult, RunResult
from stereo_frontend.frame_log import LoggedFrame

WORLD = "world"
"""Frame of the ground truth."""

_TYPES = BagTypes()
_Stamped = tuple[int, str, Message]


class Written(NamedTuple):
    """A message as it is in the bag."""

    stamp_ns: int
    topic: str
    type_name: str
    cdr: bytes


def agents_messages(result: RunResult) -> list[Written]:
    """Messages of every agent, frame by frame, for which no dense model is needed; pictures, 20 MB, are not among."""
    return [_written(m) for agent in result.agents for m in _agent_messages(agent)]


def write_result_bag(path: Path, result: RunResult, of_agents: list[Written] | None = None) -> None:
    """Write the bag, with :func:`agents_messages` if made before; one without messages for a run without any pose."""
    messages = agents_messages(result) if of_agents is None else of_agents
    messages = [*messages, *(_written(m) for agent in result.agents for m in _pictures(agent))]
    if messages:
        lasting = _lasting_messages(result, min(m.stamp_ns for m in messages))
        messages = sorted([*messages, *map(_written, lasting)], key=lambda m: (m.stamp_ns, m.topic))
    with BagWriter(path) as bag:
        for stamp, topic, type_name, cdr in messages:
            bag.write_raw(topic, type_name, cdr, stamp)


def _written(message: _Stamped) -> Written:
    stamp, topic, content = message
    type_name = content.__msgtype__
    return Written(stamp, topic, type_name, bytes(typestore().serialize_cdr(content, type_name)))


def complete_recording(path: Path, result: RunResult) -> None:
    """Add to a bag that was recorded from the nodes what only the finished run knows: dense model, plans, truth."""
    with BagReader(path) as recorded:
        stamp, types = recorded.start_ns, {topic: info.type_name for topic, info in recorded.topics.items()}
        with BagWriter(path) as bag:
            for _, topic, message in _lasting_messages(result, stamp):
                if topic not in types:
                    bag.write(topic, message, stamp)
            if (T_map_world := _truth_frame(result)) is not None and "/tf_static" in types:
                transform = transform_message(_TYPES, stamp, "map", WORLD, T_map_world)
                bag.write("/tf_static", _TYPES.TFMessage(transforms=[transform]), stamp)
            for topic, time, data in recorded.raw():
                bag.write_raw(topic, types[topic], data, time)


def _agent_messages(agent: AgentResult) -> Iterator[_Stamped]:
    prefix, odom = (f"/{agent.name}", f"{agent.name}/odom") if agent.name else ("", "odom")
    for estimate in _estimates(agent.filtered):
        message = odometry_message(_TYPES, odom, agent.base_frame, estimate)
        yield estimate.stamp_ns, f"{prefix}/odom", message
    for estimate in _estimates(agent.scan_odometry):
        message = odometry_message(_TYPES, odom, agent.base_frame, estimate)
        yield estimate.stamp_ns, f"{prefix}/ndt/odometry", message
    for estimate in _estimates(agent.trajectory):
        yield estimate.stamp_ns, f"{prefix}/pose", pose_with_covariance_message(_TYPES, "map", estimate)
    truth = _during(agent.truth, agent)
    for stamp, T in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
        yield stamp, f"{prefix}/ground_truth/pose", pose_stamped_message(_TYPES, stamp, WORLD, T)
    yield from _transforms(agent, prefix, odom)


def _pictures(agent: AgentResult) -> Iterator[_Stamped]:
    for frame in agent.frames:
        yield from _frame_messages(f"/{agent.name}" if agent.name else "", frame)


def _during(truth: Trajectory, agent: AgentResult) -> Trajectory:
    """The truth of the time of the run: a reference that goes on for hours would stretch the bag."""
    stamps = agent.filtered.stamps_ns
    if not len(stamps) or not len(truth):
        return truth.select(np.zeros(len(truth), dtype=bool))
    return truth.select((truth.stamps_ns >= stamps[0]) & (truth.stamps_ns <= stamps[-1]))


def _frame_messages(prefix: str, frame: LoggedFrame) -> Iterator[_Stamped]:
    """The picture with its features drawn, its calibration, and the features in space."""
    stamp = frame.stamp_ns
    header = header_message(_TYPES, stamp, frame.features.frame_id)
    image = compressed_image_message(_TYPES, header, frame.jpeg, "jpeg")
    yield stamp, f"{prefix}/features/image/compressed", image
    messages = features_messages(_TYPES, frame.features)
    yield stamp, f"{prefix}/features/camera_info", messages.camera_info
    yield stamp, f"{prefix}/features", messages.cloud


def _transforms(agent: AgentResult, prefix: str, odom: str) -> Iterator[_Stamped]:
    _, joined, filtered = np.intersect1d(agent.trajectory.stamps_ns, agent.filtered.stamps_ns, return_indices=True)
    for i, j in zip(joined, filtered, strict=True):
        stamp = int(agent.trajectory.stamps_ns[i])
        T_odom_base = agent.filtered.poses[j]
        T_map_odom = agent.trajectory.poses[i] @ invert_transform(T_odom_base)
        to_odom = transform_message(_TYPES, stamp, "map", odom, T_map_odom)
        to_base = transform_message(_TYPES, stamp, odom, agent.base_frame, T_odom_base)
        yield stamp, "/tf", _TYPES.TFMessage(transforms=[to_odom, to_base])
        yield stamp, f"{prefix}/map_to_odom", to_odom


def _lasting_messages(result: RunResult, stamp: int) -> Iterator[_Stamped]:
    """Yield the messages that hold all the time, stamped with the first time of the bag."""
    yield stamp, "/tf_static", _static_transforms(result, stamp)
    for agent in result.agents:
        prefix = f"/{agent.name}" if agent.name else ""
        path = path_message(_TYPES, stamp, "map", _estimates(agent.trajectory))
        yield stamp, f"{prefix}/map/path", path
        if len(truth := _during(agent.truth, agent)):
            yield stamp, f"{prefix}/ground_truth/path", path_message(_TYPES, stamp, WORLD, _estimates(truth))
    header, landmarks = header_message(_TYPES, stamp, "map"), result.landmarks
    ids = np.arange(len(landmarks.positions), dtype=np.int64)
    known = landmarks.positions, landmarks.covariances, ids
    yield stamp, "/map/landmarks", landmark_cloud(_TYPES, header, *known, landmarks.sightings.astype(np.int32))
    yield stamp, "/map/ellipsoids", ellipsoid_markers(_TYPES, header, *known)
    yield stamp, "/map/dense_cloud", cloud_message(_TYPES, header, cloud_of(result.dense))
    yield stamp, "/map/graph", graph_message(_TYPES, header, result.map)
    if result.map.marks.marks:
        yield stamp, "/map/marks", marks_message(_TYPES, header, result.map.mark_positions())
    for number, plan in enumerate(result.floor_plans):
        topic = f"/map/occupancy_{number}" if number else "/map/occupancy"
        yield stamp, topic, occupancy_message(_TYPES, header, plan.cells, plan.resolution, plan.T_map_plan)


def _static_transforms(result: RunResult, stamp: int) -> Message:
    """Every sensor's frame below its rig, so that none has two parents, and the truth's frame below the map."""
    mounts = [(agent.base_frame, frame, T) for agent in result.agents for frame, T in agent.mounts.items()]
    if (T_map_world := _truth_frame(result)) is not None:
        mounts.append(("map", WORLD, T_map_world))
    return _TYPES.TFMessage(transforms=[transform_message(_TYPES, stamp, *mount) for mount in mounts])


def _truth_frame(result: RunResult) -> FloatArray | None:
    """T_map_world of the first agent that has a truth."""
    return next((T for a in result.agents if (T := _map_from_world(a)) is not None), None)


def _map_from_world(agent: AgentResult) -> FloatArray | None:
    """T_map_world that fits the truth to an agent's trajectory, as its ATE does; None without truth."""
    if not len(agent.truth):
        return None
    try:
        matched, truth = associate(agent.trajectory, agent.truth)
    except ValueError:
        return np.eye(4)
    if len(truth) < 3:
        return np.asarray(matched.poses[0] @ invert_transform(truth[0]))
    return umeyama(truth[:, :3, 3], matched.poses[:, :3, 3])


def _estimates(trajectory: Trajectory) -> list[PoseEstimate]:
    covariances = np.zeros((len(trajectory), 6, 6)) if trajectory.covariances is None else trajectory.covariances
    return [
        PoseEstimate(int(stamp), T, P)
        for stamp, T, P in zip(trajectory.stamps_ns, trajectory.poses, covariances, strict=True)
    ]
