# SPDX-License-Identifier: Apache-2.0
"""The gate at the filter's door: features that cannot be measurements stay outside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ekf_slam_node.filtering.landmarks import KEPT_FOR_NS
from ekf_slam_node.filtering.models import Frame, FrameCamera, frame_from_features
from slam_core.camera import MIN_DEPTH
from slam_core.geometry import FloatArray, invert_transform
from slam_core.runtime.in_place import in_place
from slam_core.tags import is_tag_corner, whole_tags
from slam_core.types import Features, RigCamera

_MAX_RELATIVE_DEPTH_SIGMA = 0.3
"""Features of a larger sigma of depth / depth are not used; a limit that cuts through many favours those whose noise
makes them look near and biases the motion.
"""
_MIN_SIGMA_PX = 0.05
"""Floor of the pixel noise, px."""
_MIN_SIGMA_DEPTH = 1e-4
"""Floor of the depth noise, m."""

_FARTHEST_M, _LARGEST_PX, _SMALLEST_SIGMA = 1e5, 1e6, 1e-6
"""Limits of what can be a feature: depth m, pixel, standard deviation px or m."""


def usable_features(features: Features) -> np.ndarray:
    """Mask (n,) of the features that are finite, within sensible limits and of a depth known well enough."""
    usable = np.asarray(np.isfinite(features.descriptors).all(axis=1))
    _keep_possible(features.uv, features.depth, features.sigma_uv, features.sigma_depth, usable)
    return usable


@in_place()
def _keep_possible(uv, depth, sigma_uv, sigma_depth, usable):  # type: ignore[no-untyped-def]
    """Clear the marks of features that cannot be measurements; NaN passes no comparison."""
    for n in range(len(usable)):
        usable[n] &= depth[n] > MIN_DEPTH and depth[n] < _FARTHEST_M
        usable[n] &= abs(uv[n, 0]) < _LARGEST_PX and abs(uv[n, 1]) < _LARGEST_PX
        usable[n] &= _SMALLEST_SIGMA < sigma_uv[n, 0] < np.inf and _SMALLEST_SIGMA < sigma_uv[n, 1] < np.inf
        usable[n] &= _SMALLEST_SIGMA < sigma_depth[n] < _MAX_RELATIVE_DEPTH_SIGMA * depth[n]


def frame_of_strongest(features: Features, usable: np.ndarray, most: int) -> Frame:
    """Usable features as a frame: the strongest of all cameras, ``most`` for each, in their own order."""
    most *= max(1, len(features.cameras))
    index = np.flatnonzero(usable)
    if len(index) > most:
        index = np.sort(index[np.argsort(-features.response[index], kind="stable")[:most]])
    return frame_from_features(features, index, _MIN_SIGMA_PX, _MIN_SIGMA_DEPTH)


def mounted(
    frame: Frame, cameras: Sequence[RigCamera], T_rig_optical: FloatArray, mountings: Mapping[str, FloatArray]
) -> Frame:
    """The frame of features of several ``cameras``, each where ``mountings`` (T_rig_optical by frame) has it."""
    T_first_rig = invert_transform(T_rig_optical)
    seen = tuple(FrameCamera(c.camera, T_first_rig @ mountings[c.frame_id], c.number) for c in cameras)
    return replace(frame, cameras=seen) if seen else frame


class LinkedCameras:
    """The cameras of a rig's newest frame that was linked."""

    def __init__(self) -> None:
        self._numbers: frozenset[int] = frozenset()
        self._stamp_ns = 0

    def take(self, frame: Frame) -> None:
        """A frame was linked, or begins the map."""
        self._numbers, self._stamp_ns = frozenset(frame.camera_numbers), frame.stamp_ns

    def go_on_without(self, frame: Frame) -> bool:
        """True if a camera that is not among an unlinked frame's own was linked just now: its next one will be, too."""
        is_recent = frame.stamp_ns - self._stamp_ns < KEPT_FOR_NS
        return is_recent and bool(frame.cameras) and bool(self._numbers - set(frame.camera_numbers))


def without_tags(features: Features) -> tuple[Features, Frame | None]:
    """The features, and the corners of fiducial tags among them as a frame: four of each tag, one tag after the other.

    ``None`` where there is no tag; a tag with a corner that cannot be a measurement is left out.
    """
    is_corner = is_tag_corner(features.track_ids)
    if not is_corner.any():
        return features, None
    usable = np.flatnonzero(usable_features(features) & is_corner)
    tags = whole_tags(features.track_ids[usable])
    corners = usable[np.concatenate([*tags.values(), np.zeros(0, np.int64)]).astype(np.int64)]
    frame = frame_from_features(features, corners, _MIN_SIGMA_PX, _MIN_SIGMA_DEPTH)
    return features.select(np.flatnonzero(~is_corner)), frame if len(frame) else None
