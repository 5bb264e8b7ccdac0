# SPDX-License-Identifier: Apache-2.0
"""The ``features`` topics: a point cloud, the descriptors as an image, and the rectified camera, all of one stamp."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam_core.messages.base import Message, MessageTypes, header_message, stamp_ns
from slam_core.messages.cameras import camera_info_from_message, camera_info_message, rectified_info
from slam_core.messages.clouds import cloud_from_message, cloud_message
from slam_core.messages.images import image_from_message, image_message
from slam_core.types import Features

FEATURE_FIELDS = ("x", "y", "z", "u", "v", "depth", "sigma_u", "sigma_v", "sigma_depth", "response", "source")
"""Fields of the ``features`` cloud in this order, each FLOAT32 and of count 1."""

TRACK_FIELD = "track"
"""Last field, FLOAT32: id of a feature that was followed, below 2^24, or 0. Older bags have none."""

_DTYPE = np.dtype([(name, "<f4") for name in (*FEATURE_FIELDS, TRACK_FIELD)])


class FeatureMessages(NamedTuple):
    """One instant's features as messages: PointCloud2, Image 32FC1 (one row per feature), CameraInfo."""

    cloud: Message
    descriptors: Message
    camera_info: Message


FEATURE_TOPICS = {"features": "PointCloud2", "features/descriptors": "Image", "features/camera_info": "CameraInfo"}
"""Topic and type of each field of :class:`FeatureMessages`, in its order."""


def features_messages(types: MessageTypes, features: Features) -> FeatureMessages:
    """Messages that carry ``features`` exactly."""
    f = features
    columns = [f.xyz, f.uv, f.depth, f.sigma_uv, f.sigma_depth, f.response, f.source, f.track_ids]
    table = (
        np.column_stack([np.asarray(c, dtype="<f4") for c in columns])
        if len(f)
        else np.empty((0, len(FEATURE_FIELDS) + 1), "<f4")
    )
    header = header_message(types, f.stamp_ns, f.frame_id)
    return FeatureMessages(
        cloud_message(types, header, np.ascontiguousarray(table).view(_DTYPE)[:, 0]),
        image_message(types, header, np.asarray(f.descriptors, dtype="<f4")),
        camera_info_message(types, header, rectified_info(f.camera)),
    )


def features_from_messages(cloud: Message, descriptors: Message, camera_info: Message) -> Features:
    """Inverse of :func:`features_messages`.

    Raises
    ------
    ValueError
        If fields are missing, a number is not finite, or cloud and descriptors differ in length.
    """
    points = cloud_from_message(cloud)
    names = points.dtype.names or ()
    if missing := [name for name in FEATURE_FIELDS if name not in names]:
        raise ValueError(f"features cloud has no field {', '.join(missing)}")
    fields = [points[name].ravel().astype(np.float32) for name in FEATURE_FIELDS]
    tracks = points[TRACK_FIELD].ravel().astype(np.int32) if TRACK_FIELD in names else np.zeros(points.size, np.int32)
    rows = image_from_message(descriptors)
    count = points.size
    if rows.dtype != np.float32 or rows.ndim != 2 or len(rows) != count:
        raise ValueError(f"{count} features need as many rows of 32FC1 descriptors, got {rows.dtype} {rows.shape}")
    if not all(np.isfinite(values).all() for values in (*fields, rows)):
        raise ValueError("features contain numbers that are not finite")
    # Each array is contiguous, as the extractor made it: sums over views of one table round otherwise.
    return Features(
        stamp_ns(cloud), np.column_stack(fields[0:3]), np.column_stack(fields[3:5]), fields[5],
        np.column_stack(fields[6:8]), fields[8], fields[9], fields[10].astype(np.uint8), rows,
        camera_info_from_message(camera_info).rectified, cloud.header.frame_id, tracks,
    )  # fmt: skip
