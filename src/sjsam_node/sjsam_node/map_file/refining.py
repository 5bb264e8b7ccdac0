# SPDX-License-Identifier: Apache-2.0
"""Further landmarks of a submap that the map has already: the map with them, all else where it was."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.map_file.storage import StoredMap
from sjsam_node.smoothing.stored import estimate_arrays, stored_state
from slam_core.types import Submap


def has_more(submap: Submap, known: Submap) -> bool:
    """True if a submap is another one with further landmarks behind those that are known."""
    n = len(known.landmarks)
    return (
        len(submap.landmarks) > n
        and submap.start_stamp_ns == known.start_stamp_ns
        and submap.end_stamp_ns == known.end_stamp_ns
        and bool(np.array_equal(submap.landmark_ids[:n], known.landmark_ids))
    )


def lacking(graph: MapGraph, submap: Submap) -> int | None:
    """Number of the record that a submap has further landmarks of, or None."""
    key = submap.agent, submap.session, submap.index
    number = next((i for i, r in enumerate(graph.records) if r.key == key), None)
    return number if number is not None and has_more(submap, graph.records[number].submap) else None


def refined(stored: StoredMap, number: int, submap: Submap) -> StoredMap:
    """A map in which a record has a submap with further landmarks, placed by the record's pose.

    Settled, all is joined anew, with what came now in its place.
    """
    graph, before = stored.state.graph, stored.state.graph.records[number]
    arrays = estimate_arrays(stored.state)
    T = stored.state.start(number)
    further = submap.landmarks[len(before.submap.landmarks) :] @ T[:3, :3].T + T[:3, 3]
    behind = before.first_observation + len(before.submap.landmarks)
    points = arrays["points"]
    arrays["points"] = np.concatenate([points[:behind], further, points[behind:]])
    submaps = [(r.start, submap if i == number else r.submap) for i, r in enumerate(graph.records)]
    return replace(stored, state=stored_state(submaps, graph.links, arrays), is_out_of_order=True)


def undecided(graph: MapGraph, pending: Iterable[Link]) -> frozenset[tuple[str, int, int]]:
    """Agent, session and index of submaps whose closures wait, since too little speaks for them."""
    return frozenset(graph.records[record].key for link in pending for record in link.ends)
