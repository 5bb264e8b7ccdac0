# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags of the joined map: pose with covariance of each, sightings, and those that were moved."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from sjsam_node.graph.map_graph import BUILDING
from sjsam_node.smoothing.map_snapshot import MapLandmarks, MapSnapshot
from sjsam_node.tags.tag_links import tags_of
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, quaternion_from_rotation, skew
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.tags import square

_PROBABILITY = 0.9999
"""Share of tags seen in two parts of a way that stay one place."""


@dataclass(frozen=True, eq=False)
class MapTag:
    """One place of a tag: T_map_tag (4, 4) with covariance (6, 6), its edge (m), and the submaps that saw it there.

    is_tied: hangs on the map's own part. is_known: a file says where it is, and it is there.
    """

    number: int
    T: FloatArray
    covariance: FloatArray
    size: float
    submaps: int
    is_tied: bool
    is_known: bool


def map_tags(snapshot: MapSnapshot, landmarks: MapLandmarks) -> tuple[MapTag, ...]:
    """The places of all tags, by number; ``landmarks``: of the same snapshot."""
    row_of = {landmark: row for row, landmark in enumerate(landmarks.ids.tolist())}
    places: dict[tuple[int, int], list[tuple[str, IntArray]]] = defaultdict(list)
    first = 0
    for submap in snapshot.submaps:
        own = snapshot.landmark_of[first : first + len(submap.landmarks)]
        first += len(submap.landmarks)
        for tag, rows in tags_of(submap).items():
            corners = own[rows]
            if all(c in row_of for c in corners.tolist()):
                places[tag, int(corners[0])].append((submap.agent, corners))
    out = []
    for (tag, _), seen in sorted(places.items()):
        rows = np.array([row_of[c] for c in seen[0][1].tolist()])
        is_known = any(agent == BUILDING for agent, _ in seen)
        out.append(_map_tag(tag, landmarks, rows, len(seen) - is_known, is_known))
    return tuple(out)


def _map_tag(tag: int, landmarks: MapLandmarks, rows: np.ndarray, submaps: int, is_known: bool) -> MapTag:
    points, blocks = landmarks.positions[rows], landmarks.covariances[rows]
    size = float(np.mean(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)))
    T = umeyama(square(size), points)
    arms = points - T[:3, 3]
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -skew(arms)], axis=2)
    # Corners share most of their error: their blocks count as one measurement, not as four.
    information = np.einsum("nij,nik,nkl->jl", J, np.linalg.inv(blocks), J) / len(arms)
    return MapTag(tag, T, np.linalg.inv(information), size, submaps, bool(landmarks.linked[rows].all()), is_known)


def moved_tags(tags: Sequence[MapTag]) -> list[int]:
    """Tags that the map has in places apart: they were moved, or two carry one number."""
    places: dict[int, list[MapTag]] = defaultdict(list)
    for tag in tags:
        if tag.is_tied:
            places[tag.number].append(tag)
    return sorted(n for n, own in places.items() if any(_are_apart(a, b) for a, b in combinations(own, 2)))


def _are_apart(a: MapTag, b: MapTag) -> bool:
    """True if two places are further apart than their covariances and the tag's own size explain."""
    gap = a.T[:3, 3] - b.T[:3, 3]
    nis = gap @ np.linalg.solve(a.covariance[:3, :3] + b.covariance[:3, :3], gap)
    return bool(nis > chi_square_bound(_PROBABILITY, 3) and np.linalg.norm(gap) > 0.5 * min(a.size, b.size))


def tags_text(tags: Sequence[MapTag]) -> str:
    """Line about the tags of the map, or "" without any."""
    seen = {t.number for t in tags if t.submaps}
    if not seen:
        return ""
    known = sum(t.is_known and t.submaps > 0 for t in tags)
    text = f"{len(seen)} tag{'s' * (len(seen) != 1)} seen" + (f", {known} where the file has them" if known else "")
    if moved := moved_tags(tags):
        names = ", ".join(map(str, moved))
        text += f"; in more than one place: {names} (moved, or two with one number; no closure between these places)"
    return text


def tags_summary(tags: Sequence[MapTag]) -> dict[str, Any]:
    """Entry of a summary: tags seen, known ones that are where the file says, and those in more than one place."""
    return {
        "seen": len({t.number for t in tags if t.submaps}),
        "where_known": [t.number for t in tags if t.is_known and t.submaps],
        "in_more_than_one_place": moved_tags(tags),
        "is_in_building_frame": any(t.is_known and t.submaps for t in tags),
    }


def tags_file(tags: Sequence[MapTag]) -> dict[str, Any]:
    """The tags of the map's own part as a file of known tags has them; each once, where most submaps saw it."""
    best: dict[int, MapTag] = {}
    for tag in tags:
        if tag.is_tied and tag.submaps and tag.submaps > getattr(best.get(tag.number), "submaps", 0):
            best[tag.number] = tag
    return {"tags": [_row(tag) for _, tag in sorted(best.items())]}


def _row(tag: MapTag) -> dict[str, Any]:
    sigma = [float(np.sqrt(np.linalg.eigvalsh(tag.covariance[k : k + 3, k : k + 3])[-1])) for k in (0, 3)]
    return {
        "id": tag.number,
        "position": [round(v, 6) for v in tag.T[:3, 3].tolist()],
        "quaternion": [round(v, 8) for v in quaternion_from_rotation(tag.T[:3, :3]).tolist()],
        "size": round(tag.size, 6),
        "sigma": round(sigma[0], 6),
        "sigma_angle": round(sigma[1], 6),
    }
