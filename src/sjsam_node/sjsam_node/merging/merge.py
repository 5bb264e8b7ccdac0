# SPDX-License-Identifier: Apache-2.0
"""Merges finished maps: their submaps are joined in one canonical order, as if all had come to one session.

One process alone writes the map. What can be found without it is found ahead by tasks: which submaps look alike, and
how they align by looks; when the map settles, tasks compare what has come near, and the last optimum is found as a tree
over regions. The map has the same bytes however many workers there are, and in whatever order the maps are named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.marks import Marks
from sjsam_node.merging.across import AcrossMaps
from sjsam_node.merging.by_records import ByRecords
from sjsam_node.merging.moved import without
from sjsam_node.merging.union import NamedMap, Union, united
from sjsam_node.regions.tasks import Tasks
from sjsam_node.regions.tree_problem import optimized_by_tree


@dataclass(frozen=True, eq=False)
class Merged:
    """The merged map.

    parts: the names of the maps in each part that nothing ties to the others, larger ones first; closures: between
    submaps of different maps; notes: lines for the user.
    """

    map: GlobalMap
    parts: tuple[tuple[str, ...], ...]
    closures: int
    notes: tuple[str, ...]


def merge(
    maps: Sequence[NamedMap],
    config: GlobalMapConfig,
    tasks: Tasks,
    on_step: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> Merged:
    """Merge maps; ``on_step`` is told what is done, and how far, for a progress bar.

    Raises
    ------
    ValueError
        If there is no map with submaps, or two of them cannot be in one map.
    """
    union = united(maps)
    count, merged = len(union.submaps), GlobalMap(config)
    on_step("recognising places", 0, count)
    across = AcrossMaps(union, config.closure, tasks)
    if moved := across.moved():
        on_step("recognising places without what was moved", 0, count)
        union = without(union, moved)
        across = AcrossMaps(union, config.closure, tasks)
    ahead = ByRecords(merged, union, across)
    merged.detector.verifier.looks = ahead
    for k, submap in enumerate(union.submaps):
        on_step("joining", k, count)
        merged.add_again(submap)
    on_step("settling", count, count)
    merged.detector.compare = ahead.compare
    merged.estimate.optimize = partial(optimized_by_tree, tasks=tasks)
    merged.settle()
    merged.detector.verifier.looks = {}
    merged.detector.compare = merged.estimate.optimize = None
    merged.marks = _marks(merged, union)
    numbers = [ahead.number(record) for record in range(len(merged.state.graph.records))]
    refused = count - sum(number is not None for number in numbers)
    notes = union.notes + (f"{refused} submaps could not be joined: {dict(merged.counters.counts)}",) * bool(refused)
    own = [None if number is None else union.source[number] for number in numbers]
    between = sum(
        k.is_closure and own[k.first] != own[k.second] and None not in (own[k.first], own[k.second])
        for k in merged.state.graph.links
    )
    return Merged(merged, _parts(merged, own, union.names), between, notes)


def _marks(merged: GlobalMap, union: Union) -> Marks:
    """The marks of all maps, each on the submap that it hung on."""
    out, graph = [], merged.state.graph
    for placed in union.marks:
        number = merged.agents.record(*placed.key)
        if number is not None:
            record = graph.records[number]
            out.append(replace(placed.mark, node=record.end if placed.at_end else record.start))
    return Marks(out)


def _parts(merged: GlobalMap, source: list[int | None], names: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Names of the maps of each part; a map that is in several parts is named in each, one of no map is none."""
    state = merged.state
    members = [state.records_in(component) for component in state.components()]
    ordered = sorted(members, key=lambda records: (-len(records), records[0]))
    sources = [sorted({k for i in records if (k := source[i]) is not None}) for records in ordered]
    return tuple(tuple(names[k] for k in of_part) for of_part in sources if of_part)
