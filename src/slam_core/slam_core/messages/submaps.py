# SPDX-License-Identifier: Apache-2.0
"""The ``submap/*`` topics: one submap as a set of messages of one stamp (its end) in the frame ``<agent>/submap_<k>``.

==========================  =================================================================================
``submap/landmarks``        PointCloud2 for the eye: x y z, id, sightings, marginal covariances
``submap/descriptors``      Image 32FC1, one row per landmark
``submap/gaussian``         Image 64FC1, 6 + 3n rows: the mean (end pose tangent, landmarks), then half the covariance
``submap/path``             the rig poses inside, for the eye
``submap/path_covariance``  Image 64FC1, one row per pose: the upper 3x4 of T_start_rig, then its 6x6 covariance
``submap/info``             DiagnosticArray: agent, session, index, start and end stamp, whether it follows the last
==========================  =================================================================================

Over a thin link descriptors and Gaussian can go out compact, in half the bytes or less
(:mod:`~slam_core.messages.submap_packing`), which rounds; whoever receives them need not be told. Standard messages
have no field for what ``submap/info`` says; a DiagnosticArray has a stamp and reads well in any tool.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam_core.geometry import FloatArray, boxminus, boxplus
from slam_core.messages.base import Message, MessageTypes, header_message, stamp_ns
from slam_core.messages.clouds import cloud_from_message, landmark_cloud
from slam_core.messages.images import image_from_message, image_message
from slam_core.messages.poses import path_message
from slam_core.messages.submap_packing import (
    full_gaussian,
    pack_descriptors,
    pack_gaussian,
    unpack_descriptors,
    unpack_gaussian,
)
from slam_core.types import AnyArray, PoseEstimate, Submap

_POSE_COLUMNS = 12 + 36


class SubmapMessages(NamedTuple):
    """One submap as messages."""

    landmarks: Message
    descriptors: Message
    gaussian: Message
    path: Message
    path_covariance: Message
    info: Message


SUBMAP_TOPICS = {
    "submap/landmarks": "PointCloud2",
    "submap/descriptors": "Image",
    "submap/gaussian": "Image",
    "submap/path": "Path",
    "submap/path_covariance": "Image",
    "submap/info": "DiagnosticArray",
}
"""Topic and type of each field of :class:`SubmapMessages`, in its order."""


def submap_messages(types: MessageTypes, submap: Submap, *, compact: bool = False) -> SubmapMessages:
    """Messages that carry ``submap``; ``compact`` ones carry it :func:`rounded`."""
    header = header_message(types, submap.end_stamp_ns, submap.frame_id)
    mean, descriptors = _mean(submap), submap.descriptors.astype("<f4")
    gaussian = pack_gaussian(mean, submap.covariance) if compact else full_gaussian(mean, submap.covariance)
    return SubmapMessages(
        landmark_cloud(types, header, submap.landmarks, _marginals(submap), submap.landmark_ids, submap.sightings),
        image_message(types, header, pack_descriptors(descriptors) if compact else descriptors),
        image_message(types, header, gaussian),
        path_message(types, submap.end_stamp_ns, submap.frame_id, submap.path),
        image_message(types, header, _pose_rows(submap.path)),
        _info_message(types, header, submap),
    )


def rounded(submap: Submap) -> Submap:
    """The submap as it comes out of its compact messages."""
    mean, covariance = unpack_gaussian(pack_gaussian(_mean(submap), submap.covariance))
    descriptors = unpack_descriptors(pack_descriptors(submap.descriptors))
    end_pose = _end_pose(submap.path, mean)
    return replace(
        submap, end_pose=end_pose, landmarks=mean[6:].reshape(-1, 3), covariance=covariance, descriptors=descriptors
    )


def submap_from_messages(messages: SubmapMessages) -> Submap:
    """The submap of a set of messages, full or compact.

    Raises
    ------
    ValueError
        If the messages differ in stamp or frame, or if their sizes do not fit each other.
    """
    _check_same_set(messages)
    info = _read_info(messages.info)
    cloud = cloud_from_message(messages.landmarks)
    mean, covariance = unpack_gaussian(image_from_message(messages.gaussian))
    if len(mean) != 6 + 3 * len(cloud):
        raise ValueError(
            f"submap/gaussian of {len(cloud)} landmarks must have {6 + 3 * len(cloud)} rows, got {len(mean)}"
        )
    path = _read_path(messages)
    return Submap(
        agent=info["agent"],
        index=int(info["index"]),
        start_stamp_ns=int(info["start_stamp_ns"]),
        end_stamp_ns=int(info["end_stamp_ns"]),
        end_pose=_end_pose(path, mean),
        landmarks=mean[6:].reshape(-1, 3),
        covariance=covariance,
        landmark_ids=cloud["id"].astype(np.int64),
        sightings=cloud["sightings"].astype(np.int32),
        descriptors=unpack_descriptors(image_from_message(messages.descriptors)),
        path=path,
        follows_previous=info["follows_previous"] == "true",
        session=int(info["session"]),
    )


def _mean(submap: Submap) -> FloatArray:
    return np.concatenate([boxminus(submap.end_pose, np.eye(4)), submap.landmarks.ravel()])


def _end_pose(path: tuple[PoseEstimate, ...], mean: FloatArray) -> FloatArray:
    """The path's last pose, which is sent in 64 bits."""
    return path[-1].T if path else boxplus(np.eye(4), mean[:6])


def _marginals(submap: Submap) -> FloatArray:
    n = len(submap.landmarks)
    blocks = submap.covariance[6:, 6:].reshape(n, 3, n, 3)
    return np.asarray(blocks[np.arange(n), :, np.arange(n), :])


def _pose_rows(path: tuple[PoseEstimate, ...]) -> FloatArray:
    rows = [np.concatenate([p.T[:3].ravel(), p.covariance.ravel()]) for p in path]
    return np.array(rows, dtype="<f8").reshape(len(path), _POSE_COLUMNS)


def _read_path(messages: SubmapMessages) -> tuple[PoseEstimate, ...]:
    stamps = [stamp_ns(pose) for pose in messages.path.poses]
    rows = _matrix(messages.path_covariance, "path_covariance", len(stamps), _POSE_COLUMNS)
    last_row = np.array([[0.0, 0.0, 0.0, 1.0]])
    return tuple(
        PoseEstimate(stamp, np.vstack([row[:12].reshape(3, 4), last_row]), row[12:].reshape(6, 6))
        for stamp, row in zip(stamps, rows, strict=True)
    )


def _matrix(message: Message, name: str, rows: int, columns: int) -> AnyArray:
    matrix = image_from_message(message)
    if matrix.dtype != np.float64 or matrix.shape != (rows, columns):
        raise ValueError(f"submap/{name} must be 64FC1 of shape {(rows, columns)}, got {matrix.dtype} {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"submap/{name} contains numbers that are not finite")
    return matrix


def _info_message(types: MessageTypes, header: Message, submap: Submap) -> Message:
    values = {
        "agent": submap.agent,
        "session": str(submap.session),
        "index": str(submap.index),
        "start_stamp_ns": str(submap.start_stamp_ns),
        "end_stamp_ns": str(submap.end_stamp_ns),
        "follows_previous": "true" if submap.follows_previous else "false",
        "landmarks": str(len(submap.landmarks)),
    }
    entries = [types.KeyValue(key=key, value=value) for key, value in values.items()]
    status = types.DiagnosticStatus(name=submap.frame_id, message="submap finished", values=entries)
    return types.DiagnosticArray(header=header, status=[status])


def _read_info(message: Message) -> dict[str, str]:
    if len(message.status) != 1:
        raise ValueError(f"submap/info must have one status, got {len(message.status)}")
    values = {entry.key: entry.value for entry in message.status[0].values}
    needed = ("agent", "session", "index", "start_stamp_ns", "end_stamp_ns", "follows_previous")
    if missing := [key for key in needed if key not in values]:
        raise ValueError(f"submap/info lacks {', '.join(missing)}")
    return values


def _check_same_set(messages: SubmapMessages) -> None:
    stamps, frames = {stamp_ns(m) for m in messages}, {m.header.frame_id for m in messages}
    if len(stamps) != 1 or len(frames) != 1:
        raise ValueError(
            f"messages of one submap must share stamp and frame, got {sorted(stamps)} and {sorted(frames)}"
        )
