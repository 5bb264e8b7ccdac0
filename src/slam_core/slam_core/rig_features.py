# SPDX-License-Identifier: Apache-2.0
"""Features of several cameras of a rig as those of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam_core.tags import is_tag_corner
from slam_core.types import Features, RigCamera

MOST_CAMERAS = 8
"""Cameras of one rig: tracks of the front ends stay apart by it."""


def features_of_rig(parts: Sequence[tuple[int, Features]]) -> Features:
    """The features of cameras (their numbers on the rig) at one instant, under the stamp of the first of them.

    Tracks are renumbered, so that no two cameras share one. A fiducial tag that two cameras see counts for the first.

    Raises
    ------
    ValueError
        If there is no part, a number is not below :data:`MOST_CAMERAS`, the descriptors differ in size, or two
        cameras have one frame.
    """
    if not parts:
        raise ValueError("a frame of a rig needs the features of at least one camera")
    sizes = {features.descriptors.shape[1] for _, features in parts if len(features)}
    if len(sizes) > 1:
        raise ValueError(f"descriptors of the cameras of a rig must be of one kind, got sizes {sorted(sizes)}")
    frames = [features.frame_id for _, features in parts]
    if len(set(frames)) < len(frames):
        raise ValueError(f"each camera of a rig needs a frame of its own, got {', '.join(frames)}")
    tags: set[int] = set()
    kept = []
    for k, (number, features) in enumerate(parts):
        if not 0 <= number < MOST_CAMERAS:
            raise ValueError(f"a rig has at most {MOST_CAMERAS} cameras, got number {number}")
        corners = is_tag_corner(features.track_ids)
        again = corners & np.isin(features.track_ids, list(tags))
        tags |= set(features.track_ids[corners].tolist())
        own = features.select(np.flatnonzero(~again)) if again.any() else features
        tracks = np.where(own.track_ids > 0, own.track_ids * MOST_CAMERAS + number, own.track_ids)
        if not len(own) and sizes:  # an empty frame of a front end that has described nothing yet
            own = replace(own, descriptors=np.zeros((0, *sizes), np.float32))
        seen_by = np.full(len(own), k, np.uint8)
        kept.append(replace(own, track_ids=tracks.astype(np.int32), seen_by=seen_by))
    joined = kept[0]
    for other in kept[1:]:
        joined = joined.joined(other)
    numbers = [number for number, _ in parts]
    return replace(
        joined, cameras=tuple(RigCamera(f.camera, f.frame_id, n) for n, f in zip(numbers, kept, strict=True))
    )
