# SPDX-License-Identifier: Apache-2.0
"""The joined map as messages, written without ROS like all conversions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sjsam_node.smoothing.map_snapshot import MapLandmarks, MapSnapshot
from slam_core.geometry import FloatArray, invert_transform
from slam_core.messages import ellipsoid_markers, landmark_cloud, path_marker, points_message, transform_message
from slam_core.messages.base import Message, MessageTypes
from slam_core.storage.anchor_file import BUILDING_FRAME, read_anchor
from slam_core.types import PoseEstimate

_SKELETON = (0.1, 0.4, 1.0, 1.0)
_CLOSURE = (0.9, 0.1, 0.1, 1.0)
_MARK = (0.1, 0.8, 0.2, 1.0)
_LINE_LIST, _SPHERE_LIST = 5, 7


def anchor_message(types: MessageTypes, path: str, map_frame: str) -> Message:
    """The static transform from the map to its building, from the ``anchor.yaml`` of ``slam anchor``."""
    anchor = read_anchor(Path(path).expanduser())
    return transform_message(types, 0, anchor.frame, map_frame, anchor.T)


def fixed_frame_message(types: MessageTypes, T_map_frame: PoseEstimate, map_frame: str) -> Message:
    """The static transform from the map to the fixed frame that positions are in."""
    return transform_message(types, 0, BUILDING_FRAME, map_frame, invert_transform(T_map_frame.T))


def map_pictures(
    types: MessageTypes, header: Message, snapshot: MapSnapshot, landmarks: MapLandmarks
) -> dict[str, Message]:
    """Messages that show a map, by topic."""
    return {
        "map/landmarks": landmarks_message(types, header, landmarks),
        "map/cloud": cloud_message(types, header, landmarks),
        "map/graph": graph_message(types, header, snapshot),
        "map/marks": marks_message(types, header, snapshot.mark_positions()),
    }


def clicked_point(message: Message, map_frame: str) -> FloatArray:
    """Point (3,) of a geometry_msgs/PointStamped of the map frame; ValueError if it is of another one."""
    if message.header.frame_id not in ("", map_frame):
        raise ValueError(f"clicked_point must be in frame {map_frame}, got {message.header.frame_id}")
    return np.array([message.point.x, message.point.y, message.point.z])


def landmarks_message(types: MessageTypes, header: Message, landmarks: MapLandmarks) -> Message:
    """``map/landmarks``: PointCloud2 with ids and covariances."""
    return landmark_cloud(
        types, header, landmarks.positions, landmarks.covariances, landmarks.ids, landmarks.sightings.astype(np.int32)
    )


def cloud_message(types: MessageTypes, header: Message, landmarks: MapLandmarks) -> Message:
    """``map/cloud``: bare points, for any tool that takes a cloud, of the landmarks whose place in the map is known."""
    return points_message(types, header, landmarks.positions[landmarks.linked].astype(np.float32))


def ellipsoids_message(types: MessageTypes, header: Message, landmarks: MapLandmarks) -> Message:
    """``map/ellipsoids``: 99.5 % ellipsoids of the landmarks whose place in the map is known."""
    known = landmarks.linked
    return ellipsoid_markers(
        types, header, landmarks.positions[known], landmarks.covariances[known], landmarks.ids[known]
    )


def graph_message(types: MessageTypes, header: Message, snapshot: MapSnapshot) -> Message:
    """``map/graph``: the skeleton as lines, one per submap, and the believed closures in another colour."""
    skeleton, closures = list(snapshot.skeleton_lines()), list(snapshot.closure_lines())
    lines = [_points(types, header, "skeleton", _LINE_LIST, skeleton, _SKELETON)]
    return types.MarkerArray(markers=[*lines, _points(types, header, "closures", _LINE_LIST, closures, _CLOSURE)])


def marks_message(types: MessageTypes, header: Message, positions: FloatArray) -> Message:
    """``map/marks``: the marked finds."""
    return types.MarkerArray(markers=[_points(types, header, "marks", _SPHERE_LIST, [positions], _MARK, 0.15)])


def _points(
    types: MessageTypes, header: Message, namespace: str, kind: int, points: list[FloatArray],
    rgba: tuple[float, float, float, float], size: float = 0.02,
) -> Message:  # fmt: skip
    stacked = np.concatenate(points) if points else np.empty((0, 3))
    marker = path_marker(types, header, stacked, namespace=namespace, colour=rgba)
    marker.type, marker.scale = kind, types.Vector3(x=size, y=size, z=size)
    return marker
