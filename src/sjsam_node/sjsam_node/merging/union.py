# SPDX-License-Identifier: Apache-2.0
"""Submaps of several finished maps in one order, which does not depend on the order in which the maps are named.

A submap that several of them hold, because one was extended or merged from another, is taken once, whatever its agent
is called. An agent is renamed where another map has other submaps of the same session of an agent of that name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.agents import Key, in_order
from sjsam_node.graph.map_graph import BUILDING, Record
from sjsam_node.graph.marks import Mark
from sjsam_node.map_file.storage import StoredMap
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.types import Submap


@dataclass(frozen=True, eq=False)
class NamedMap:
    """A map and what a user calls it."""

    name: str
    stored: StoredMap

    @property
    def records(self) -> tuple[Record, ...]:
        """Its submaps."""
        return self.stored.state.graph.records


@dataclass(frozen=True, eq=False)
class PlacedMark:
    """A mark, and the submap that it hangs on, at its start or end."""

    mark: Mark
    key: Key
    at_end: bool


@dataclass(frozen=True, eq=False)
class Union:
    """All submaps, in the order in which they are joined.

    names: of the maps, in their canonical order; source: the map that each submap is of; landmarks: of each submap,
    the landmark of that map that each of its landmarks is there, (n,); notes: lines for the user about what was renamed
    or left out.
    """

    submaps: tuple[Submap, ...]
    source: tuple[int, ...]
    landmarks: tuple[IntArray, ...]
    names: tuple[str, ...]
    marks: tuple[PlacedMark, ...]
    notes: tuple[str, ...]


def united(maps: Sequence[NamedMap]) -> Union:
    """The submaps of some maps.

    Raises
    ------
    ValueError
        If there is none, or two maps cannot be in one: their descriptors, tags of the building or sessions differ.
    """
    kinds = {m.records[0].submap.descriptors.shape[1] for m in maps if m.records}
    if len(kinds) > 1:
        raise ValueError(f"descriptors of {sorted(kinds)} columns: these maps were made with different features")
    ordered = sorted((m for m in maps if m.records), key=_canonical)
    if not ordered:
        raise ValueError("there is no map with submaps to merge")
    taken = _Taken()
    for number, one in enumerate(ordered):
        taken.add(number, one)
    submaps = in_order(submap for submap, _ in taken.submaps.values())
    source = tuple(taken.submaps[_key(s)][1] for s in submaps)
    landmarks = tuple(taken.landmarks[_key(s)] for s in submaps)
    return Union(
        tuple(submaps), source, landmarks, tuple(m.name for m in ordered), tuple(taken.marks), tuple(taken.notes)
    )


def _canonical(one: NamedMap) -> tuple[int, int, bytes]:
    """Sort key: when it began, the larger one first, and a digest of what is in it."""
    submaps, content = [r.submap for r in one.records], hashlib.sha256()
    for submap in submaps:
        content.update(repr(_key(submap)).encode() + _digest(submap))
        content.update(np.ascontiguousarray(submap.landmarks).tobytes())
    return min(s.start_stamp_ns for s in submaps), -len(submaps), content.digest()


def _digest(submap: Submap) -> bytes:
    """Digest of a submap, whatever its agent is called and however many landmarks it has.

    A merge may have renamed the one, and let some of the others go. Tags of the building, which all maps have by the
    same name and stamps, are known by their corners; of those none is let go.
    """
    what = submap.session, submap.index, submap.start_stamp_ns, submap.end_stamp_ns
    digest = hashlib.sha256(repr(what).encode())
    digest.update(np.ascontiguousarray(submap.end_pose).tobytes())
    if submap.agent == BUILDING:
        digest.update(np.ascontiguousarray(submap.landmark_ids).tobytes())
        digest.update(np.ascontiguousarray(submap.landmarks).tobytes())
    return digest.digest()


def _key(submap: Submap) -> Key:
    return submap.agent, submap.session, submap.index


@dataclass
class _Taken:
    """Holds what was taken over of each map so far.

    submaps: by key, with the map that each is of; landmarks: by key, as that map has joined them; keys: under which the
    submap of each digest is there.
    """

    submaps: dict[Key, tuple[Submap, int]] = field(default_factory=dict)
    landmarks: dict[Key, IntArray] = field(default_factory=dict)
    keys: dict[bytes, Key] = field(default_factory=dict)
    marks: list[PlacedMark] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, number: int, one: NamedMap) -> None:
        """Take a map over."""
        digests = {r.key: _digest(r.submap) for r in one.records if not r.is_position}
        shared = {key: self.keys[digest] for key, digest in digests.items() if digest in self.keys}
        if len(shared) == len(digests):
            self.notes.append(f"{one.name}: all its submaps are in the others; it adds nothing")
        if len(digests) < len(one.records):
            self.notes.append(f"{one.name}: its positions in a fixed frame are not used")
        names = self._renamed(one, shared)
        at: dict[int, tuple[Key, bool]] = {}
        for k, record in enumerate(one.records):
            if record.is_position:
                continue
            submap = replace(record.submap, agent=names.get(record.key[:2], record.submap.agent))
            key = shared.get(record.key, _key(submap))
            at[record.start], at[record.end] = at.get(record.start, (key, False)), (key, True)
            if record.key in shared:
                continue
            if key in self.submaps:
                raise ValueError(f"{one.name} has another submap {key} than a map that it shares others with")
            self.submaps[key], self.keys[digests[record.key]] = (submap, number), key
            self.landmarks[key] = one.stored.state.graph.landmarks_of(k)
        self._add_marks(one, at)

    def _add_marks(self, one: NamedMap, at: dict[int, tuple[Key, bool]]) -> None:
        """Take the marks of a map over, but for those that an earlier map has in the same place by the same name.

        Or by the name that a merge before has given it.
        """
        names = {placed.mark.name for placed in self.marks}
        there = [(_place(placed), placed.mark.name) for placed in self.marks]
        for mark in one.stored.marks.marks:
            placed = PlacedMark(mark, *at[mark.node])
            if any(place == _place(placed) and _is_called(name, mark.name) for place, name in there):
                continue
            name = _free(mark.name, names)
            names.add(name)
            self.marks.append(replace(placed, mark=replace(mark, name=name)))

    def _renamed(self, one: NamedMap, shared: dict[Key, Key]) -> dict[tuple[str, int], str]:
        """Names of agents by session, where they change.

        A session of which submaps are there goes on under the name that they have. Where another map holds other
        submaps of a session, all sessions of that agent that are not there get a new name.
        """
        taken = {key[:2] for key in self.submaps}
        known = {key[:2]: there[0] for key, there in shared.items()}
        new = {r.key[:2] for r in one.records if not r.is_position} - known.keys()
        clashes = {agent for agent, _ in new & taken}
        if BUILDING in clashes:
            raise ValueError(f"{one.name} knows other tags of the building than another map")
        names = {agent for agent, _ in taken} | {r.submap.agent for r in one.records}
        for agent in sorted(clashes):
            name = _free(agent or "rig", names | {agent or "rig"})
            names.add(name)
            known |= {(other, session): name for other, session in new if other == agent}
            self.notes.append(f"{one.name}: its agent '{agent}' is called '{name}', since another map has one")
        return known


def _place(placed: PlacedMark) -> tuple[Key, bool, tuple[float, ...]]:
    return placed.key, placed.at_end, tuple(placed.mark.point.tolist())


def _is_called(there: str, name: str) -> bool:
    """True if a mark has a name, or that name with a number as :func:`_free` gives it."""
    stem, _, number = there.rpartition("_")
    return there == name or (stem == name and number.isdigit())


def _free(name: str, taken: set[str]) -> str:
    """The name, or the first free one with a number."""
    number = 2
    while name in taken and f"{name}_{number}" in taken:
        number += 1
    return f"{name}_{number}" if name in taken else name
