# SPDX-License-Identifier: Apache-2.0
"""The state of a map as arrays to be stored, and back; what was solved is not among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing.state import EstimateState, with_exactly
from slam_core.types import AnyArray, Submap


def estimate_arrays(state: EstimateState) -> dict[str, AnyArray]:
    """Arrays of the estimate, by the names of the format."""
    return {
        "poses": state.poses, "points": state.points, "component_of": state.component_of,
        "ties": state.graph.budgets, "redundant": state.redundant, "doubt": state.overconfidence,
    }  # fmt: skip


def stored_state(
    submaps: Iterable[tuple[int, Submap]], links: Sequence[Link], arrays: Mapping[str, AnyArray]
) -> EstimateState:
    """The state of submaps with the nodes that they start at, of links and of the arrays of the estimate."""
    graph = MapGraph()
    for start, submap in submaps:
        graph = graph.with_submap(submap, start if start < len(graph.ending_at) else None)
    graph = replace(graph, budgets=arrays["ties"])
    state = EstimateState(
        graph, arrays["poses"], arrays["points"], arrays["component_of"], arrays["doubt"], arrays["redundant"],
        np.arange(len(graph.records)),
    )  # fmt: skip
    return with_exactly(state, links)
