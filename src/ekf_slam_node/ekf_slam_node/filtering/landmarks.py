# SPDX-License-Identifier: Apache-2.0
"""Landmarks beside their positions: identity, descriptor, record of sightings (section 4.4)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.config import LandmarkConfig
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.covariance import IndexArray
from ekf_slam_node.filtering.landmark_noise import LandmarkNoise
from slam_core.geometry import FloatArray, skew
from slam_core.runtime.in_place import in_place
from slam_core.tags import is_tag_corner
from slam_core.types import Float32Array

_COLUMNS, _ROWS = 8, 6
"""Cells of the image that landmarks are spread over."""
KEPT_FOR_NS = 300_000_000
"""Time for which features of one camera wait for its next frame while other cameras have theirs."""


@dataclass(frozen=True, eq=False)
class CandidateLandmarks:
    """Features of the last frame that are no landmarks (yet): a feature becomes one when a second frame confirms it.

    candidates: points in the rig frame of that frame. ids: (n,) of the landmarks they belong to where a new submap has
    just begun, else -1. sightings: (n,) so far. free: (n,) whether the measurement may be used; where the submap before
    has used it, it only helps to link the frames. cameras: (n,) numbers of the cameras that saw them; stamps: (n,) ns,
    when. Of a rig with several cameras those of a camera that a frame is not of stay for its next one.
    """

    candidates: Candidates
    ids: IndexArray
    sightings: np.ndarray
    free: np.ndarray
    cameras: np.ndarray
    stamps: IndexArray

    def select(self, index: np.ndarray) -> CandidateLandmarks:
        """The features at ``index``."""
        return CandidateLandmarks(
            self.candidates.select(index), self.ids[index], self.sightings[index], self.free[index],
            self.cameras[index], self.stamps[index],
        )  # fmt: skip

    def joined(self, other: CandidateLandmarks) -> CandidateLandmarks:
        """Features with others after them."""
        a, b = self.candidates, other.candidates
        return CandidateLandmarks(
            Candidates(
                np.concatenate([a.points, b.points]), np.concatenate([a.covariances, b.covariances]),
                np.concatenate([a.descriptors, b.descriptors]), np.concatenate([a.tracks, b.tracks]),
            ),
            np.concatenate([self.ids, other.ids]), np.concatenate([self.sightings, other.sightings]),
            np.concatenate([self.free, other.free]), np.concatenate([self.cameras, other.cameras]),
            np.concatenate([self.stamps, other.stamps]),
        )  # fmt: skip

    def of_others(self, cameras: Collection[int], stamp_ns: int) -> CandidateLandmarks:
        """Features that other cameras than ``cameras`` saw, not long before a stamp."""
        is_recent = stamp_ns - self.stamps < KEPT_FOR_NS
        return self.select(np.flatnonzero(is_recent & ~np.isin(self.cameras, list(cameras))))

    def moved(self, T: FloatArray, covariance: FloatArray) -> CandidateLandmarks:
        """Features whose points are seen from another rig frame: by T_other_own (4, 4) of covariance (6, 6).

        The error of the motion, which they share, is part of each one's own from then on.
        """
        candidates, R = self.candidates, T[:3, :3]
        arms = candidates.points @ R.T
        J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -skew(arms)], axis=2)
        covariances = R @ candidates.covariances @ R.T + J @ covariance @ np.swapaxes(J, 1, 2)
        return replace(self, candidates=replace(candidates, points=arms + T[:3, 3], covariances=covariances))

    def without(self, index: IndexArray) -> CandidateLandmarks:
        """All but the features at ``index``."""
        keep = np.ones(len(self.ids), dtype=bool)
        keep[index] = False
        return self.select(np.flatnonzero(keep))


class LandmarkTable:
    """One row per landmark, in the order of the filter's slots."""

    def __init__(self, descriptor_size: int) -> None:
        self.ids = np.zeros(0, dtype=np.int64)
        self.sightings = np.zeros(0, dtype=np.int32)
        self.descriptors: Float32Array = np.zeros((0, descriptor_size), dtype=np.float32)
        self.tracks = np.zeros(0, dtype=np.int32)
        """Tracks of the front end by which the landmarks were last seen, 0 without one."""
        self.noise = LandmarkNoise.unknown(0)
        self._first_frame = np.zeros(0, dtype=np.int64)
        self._expected = np.zeros(0, dtype=np.int64)
        self._hits = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.ids)

    def add(
        self, ids: IndexArray, sightings: np.ndarray, descriptors: Float32Array, tracks: np.ndarray, frame: int
    ) -> None:
        """Append landmarks first seen in ``frame``."""
        self.ids = np.concatenate([self.ids, ids])
        self.sightings = np.concatenate([self.sightings, sightings.astype(np.int32)])
        self.descriptors = np.concatenate([self.descriptors, descriptors])
        self.tracks = np.concatenate([self.tracks, tracks])
        self.noise = self.noise.extended(len(ids))
        self._first_frame = np.concatenate([self._first_frame, np.full(len(ids), frame)])
        self._expected = np.concatenate([self._expected, np.zeros(len(ids), dtype=np.int64)])
        self._hits = np.concatenate([self._hits, np.zeros(len(ids), dtype=np.int64)])

    def select(self, slots: IndexArray) -> LandmarkTable:
        """A table of the landmarks ``slots`` alone, their record of hits and misses starting anew."""
        table = LandmarkTable(self.descriptors.shape[1])
        table.add(self.ids[slots], self.sightings[slots], self.descriptors[slots], self.tracks[slots], 0)
        return table

    def count(self, seen: IndexArray, descriptors: Float32Array, expected: np.ndarray) -> None:
        """Count the sightings of slots ``seen`` with their new descriptors.

        ``expected`` masks those that are in view.
        """
        self.sightings[seen] += 1
        self._hits[seen] += 1
        self._expected[expected] += 1
        # The mean of old and new follows the change of viewpoint and averages the noise.
        blended = self.descriptors[seen] + descriptors
        self.descriptors[seen] = blended / np.maximum(np.linalg.norm(blended, axis=1, keepdims=True), 1e-6)

    def unreliable(self, frame: int, config: LandmarkConfig) -> IndexArray:
        """Slots to be removed, highest first.

        Too few sightings in their first frames, or missed where they should be seen. Never the corners of tags: a
        detector that finds them less often from further away says nothing against them.
        """
        probation = (frame - self._first_frame >= config.probation_frames) & (self.sightings < config.min_sightings)
        missed = (self._expected >= config.min_expected) & (self._hits < config.min_hit_ratio * self._expected)
        return np.flatnonzero((probation | missed) & ~is_tag_corner(self.ids))[::-1]

    def remove(self, slot: int) -> None:
        """Drop a landmark; the last one takes its slot, as in the filter."""
        for name in ("ids", "sightings", "descriptors", "tracks", "_first_frame", "_expected", "_hits"):
            values = getattr(self, name)
            values[slot] = values[-1]
            setattr(self, name, values[:-1])
        self.noise.remove(slot)


def spread_choice(points_px: FloatArray, occupied_px: FloatArray, amount: int, size: tuple[int, int]) -> IndexArray:
    """Choose up to ``amount`` of the points (n, 2) px so that, with the occupied ones (m, 2), they cover the image.

    The image is divided into cells; each next point comes from the cell with the fewest so far, in the order
    given.
    """
    load, place = np.zeros(_COLUMNS * _ROWS, dtype=np.int64), np.empty(len(points_px), dtype=np.int64)
    to_cell = np.array([_COLUMNS / size[0], _ROWS / size[1]])
    _places_in_cells(points_px, occupied_px, to_cell, load, place)
    return np.argsort(place, kind="stable")[:amount]


@in_place()
def _places_in_cells(points_px, occupied_px, to_cell, load, place):  # type: ignore[no-untyped-def]
    """Place (n,) of each point in its cell's queue, behind what the cell already holds: the smallest come first."""
    for n in range(len(occupied_px)):
        load[_cell(occupied_px[n], to_cell)] += 1
    for n in range(len(points_px)):
        cell = _cell(points_px[n], to_cell)
        place[n] = load[cell]
        load[cell] += 1


@in_place()
def _cell(px, to_cell):  # type: ignore[no-untyped-def]
    column = min(max(int(px[0] * to_cell[0]), 0), _COLUMNS - 1)
    return column * _ROWS + min(max(int(px[1] * to_cell[1]), 0), _ROWS - 1)
