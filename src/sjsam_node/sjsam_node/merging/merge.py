# SPDX-License-Identifier: Apache-2.0
"""Merges finished maps: places that several of them show tie them together; then the whole is joined and settled.

One process alone writes the map. What costs most is done ahead by tasks: looking submaps up in the other maps,
comparing them, and joining as a tree over regions. The map has the same bytes however many workers there are, and in
whatever order the maps are named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from sjsam_node.closure_joining import grouped
from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.links import Link
from sjsam_node.merging.across import AcrossMaps, Alike
from sjsam_node.merging.union import NamedMap, united
from sjsam_node.regions.tasks import Tasks
from sjsam_node.regions.tree_problem import optimized_by_tree

_GROUPS = 16
"""Groups, at most about, in which the closures of a large map are joined: each costs an update of all of it."""


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
    on_step: Callable[[str], None] = lambda step: None,
) -> Merged:
    """Merge maps; ``on_step`` is told what comes next, for a progress bar.

    Raises
    ------
    ValueError
        If there is no map with submaps, or two of them cannot be in one map.
    """
    on_step("reading")
    union = united(maps)
    at_once = max(config.joined_at_once, len(union.source) // _GROUPS)
    config = replace(config, joined_at_once=at_once)
    merged = GlobalMap.of(union.stored, config)
    merged.estimate.optimize = partial(optimized_by_tree, tasks=tasks)
    state = merged.state
    across = AcrossMaps(state.graph, union.source, state.redundant, config.closure, tasks)
    merged.detector.compare = across.compare
    if len(union.names) > 1:
        on_step("recognising places")
        alike = across.alike()
        on_step("tying maps")
        left = _tie_parts(merged, alike, at_once)
        _tie_inside(merged, left, at_once)
    on_step("joining")
    merged.settle()
    merged.detector.compare = merged.estimate.optimize = None
    source = union.source.tolist()
    between = sum(source[k.first] != source[k.second] for k in merged.state.graph.links)
    return Merged(merged, _parts(merged, source, union.names), between, union.notes)


def _tie_parts(merged: GlobalMap, alike: list[Alike], at_once: int) -> list[Alike]:
    """Join closures between parts, the two parts with the surest one first; those that are left are returned."""
    detector, left, done = merged.detector, alike, list[Alike]()
    while True:
        state = merged.state
        sides = [frozenset(state.component(i) for i in one.ends) for one in left]
        at = next((k for k, side in enumerate(sides) if len(side) == 2), None)
        if at is None:
            return done + left
        chosen = [one for one, side in zip(left, sides, strict=True) if side == sides[at]][:at_once]
        believed: list[Link] = []
        for one in chosen:
            link = detector.link(*one.ends, None, *one.found)
            believed += [] if link is None else detector.judged(link)
        if believed:
            merged.join_closures(believed, max(k.second for k in believed))
        left = [one for one in left if not any(one is c for c in chosen)]
        done += chosen


def _tie_inside(merged: GlobalMap, alike: list[Alike], at_once: int) -> None:
    """Join closures between submaps that look alike where the map can judge them by now."""
    state = merged.state
    linked = {k.ends for k in state.graph.links}
    pairs = [one.ends for one in alike if one.ends not in linked]
    known = [(a, b) for a, b in pairs if state.component(a) == state.component(b)]
    for found in grouped(merged.detector.verified(known), at_once):
        merged.join_closures(found, max(k.second for k in found))


def _parts(merged: GlobalMap, source: list[int], names: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Names of the maps of each part; a map that was in parts before names each of these."""
    state = merged.state
    members = [state.records_in(component) for component in state.components()]
    ordered = sorted(members, key=lambda records: (-len(records), records[0]))
    return tuple(tuple(names[k] for k in sorted({source[i] for i in records})) for records in ordered)
