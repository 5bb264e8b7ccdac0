# SPDX-License-Identifier: Apache-2.0
"""Finished maps side by side in one: their submaps, links and estimates, renumbered; nothing ties them together yet.

Maps are taken in an order of their own, by what is in them, so that the order of the arguments does not matter. A
submap that several of them hold, because one was extended from another, is taken once. An agent is renamed where
another map has other submaps of the same session of an agent of that name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import BUILDING, Record
from sjsam_node.loop_closure.near_pairs import Compared
from sjsam_node.marks import Mark, Marks
from sjsam_node.smoothing.stored import stored_state
from sjsam_node.storage import StoredMap
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.types import Submap

Key = tuple[str, int, int]


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
class Union:
    """Maps in one, none tied to another.

    names: of the maps, in their canonical order; source (records,): the map that each record is of; notes: lines for
    the user about what was renamed or left out.
    """

    stored: StoredMap
    names: tuple[str, ...]
    source: IntArray
    notes: tuple[str, ...]


def united(maps: Sequence[NamedMap]) -> Union:
    """The maps in one.

    Raises
    ------
    ValueError
        If there is none, or their descriptors are not of one kind.
    """
    kinds = {m.records[0].submap.descriptors.shape[1] for m in maps if m.records}
    if len(kinds) > 1:
        raise ValueError(f"descriptors of {sorted(kinds)} columns: these maps were made with different features")
    ordered = sorted((m for m in maps if m.records), key=_canonical)
    if not ordered:
        raise ValueError("there is no map with submaps to merge")
    parts = _Parts()
    for number, one in enumerate(ordered):
        parts.add(number, one)
    return Union(parts.stored(), tuple(m.name for m in ordered), np.array(parts.source), tuple(parts.notes))


def _canonical(one: NamedMap) -> tuple[int, int, bytes]:
    """Sort key: when it began, the larger one first, and a digest of what is in it."""
    submaps = [r.submap for r in one.records]
    content = hashlib.sha256(one.stored.state.poses.tobytes())
    for submap in submaps:
        content.update(_content(submap))
    return min(s.start_stamp_ns for s in submaps), -len(submaps), content.digest()


def _content(submap: Submap) -> bytes:
    """Digest of a submap."""
    stamps = submap.agent, submap.session, submap.index, submap.start_stamp_ns, submap.end_stamp_ns
    digest = hashlib.sha256(repr(stamps).encode())
    digest.update(np.ascontiguousarray(submap.end_pose).tobytes())
    digest.update(np.ascontiguousarray(submap.landmarks).tobytes())
    return digest.digest()


@dataclass
class _Parts:
    """What is taken over of each map so far."""

    records: dict[Key, tuple[int, bytes]] = field(default_factory=dict)
    submaps: list[tuple[int, Submap]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)
    points: list[FloatArray] = field(default_factory=list)
    budgets: list[int] = field(default_factory=list)
    redundant: list[bool] = field(default_factory=list)
    overconfidence: list[float] = field(default_factory=list)
    links: dict[tuple[int, int], Link] = field(default_factory=dict)
    pending: list[Link] = field(default_factory=list)
    refused: list[Link] = field(default_factory=list)
    compared: list[tuple[IntArray, FloatArray]] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, number: int, one: NamedMap) -> None:
        """Take a map over."""
        shared = self._shared(one)
        if len(shared) == len(one.records):
            self.notes.append(f"{one.name}: all its submaps are in the others; it adds nothing")
        renamed = self._renamed(one, shared)
        state, record_of, node_of = one.stored.state, dict[int, int](), dict[int, int]()
        for i, record in enumerate(one.records):
            if i in shared:
                twin = shared[i]
                record_of[i], node_of[record.start], node_of[record.end] = twin, self.submaps[twin][0], self.ends[twin]
                continue
            if record.start not in node_of:
                node_of[record.start] = self._node(state.poses[record.start])
            start = node_of[record.start]
            node_of[record.end] = self._node(state.poses[record.end])
            record_of[i] = len(self.submaps)
            submap = replace(record.submap, agent=renamed.get(record.submap.agent, record.submap.agent))
            key = submap.agent, submap.session, submap.index
            if key in self.records:
                raise ValueError(f"{one.name} holds another submap {key} than a map that it shares others with")
            self.records[key] = record_of[i], _content(record.submap)
            self.submaps.append((start, submap))
            self.ends.append(node_of[record.end])
            self.source.append(number)
            self.points.append(state.points[record.observations])
            self.budgets.append(int(state.graph.budgets[i]))
            self.redundant.append(bool(state.redundant[i]))
            self.overconfidence.append(float(state.overconfidence[i]))
        self._take_links(one.stored, record_of)
        taken = {mark.name for mark in self.marks}
        for mark in one.stored.marks.marks:
            self.marks.append(replace(mark, node=node_of[mark.node], name=_free(mark.name, taken)))
            taken.add(self.marks[-1].name)

    def _node(self, T: FloatArray) -> int:
        self.poses.append(T)
        return len(self.poses) - 1

    def _shared(self, one: NamedMap) -> dict[int, int]:
        """Records of a map that are there already, and where."""
        found = {}
        for i, record in enumerate(one.records):
            known = self.records.get(record.key)
            if known is not None and known[1] == _content(record.submap):
                found[i] = known[0]
        return found

    def _renamed(self, one: NamedMap, shared: dict[int, int]) -> dict[str, str]:
        """New names of agents whose session another map holds other submaps of."""
        taken = {(agent, session) for agent, session, _ in self.records}
        own = {r.key[:2] for i, r in enumerate(one.records) if i not in shared}
        known = {one.records[i].key[:2] for i in shared}
        names = {agent for agent, _ in taken} | {r.submap.agent for r in one.records}
        if any(agent == BUILDING for agent, _ in own & taken):
            raise ValueError(f"{one.name} knows other tags of the building than another map")
        renamed = {}
        for agent in sorted({agent for agent, session in own & taken - known}):
            renamed[agent] = _free(agent or "rig", names, least=2)
            names.add(renamed[agent])
            self.notes.append(
                f"{one.name}: its agent '{agent}' is called '{renamed[agent]}', since another map has one"
            )
        return renamed

    def _take_links(self, stored: StoredMap, record_of: dict[int, int]) -> None:
        for link in _renumbered(stored.state.graph.links, record_of):
            self.links.setdefault(link.ends, link)
        self.pending += _renumbered(stored.pending, record_of)
        self.refused += _renumbered(stored.refused, record_of)
        numbers = np.array([record_of[i] for i in range(len(record_of))], dtype=np.int64)
        pairs = numbers[stored.compared.pairs]
        in_order = pairs[:, 0] < pairs[:, 1]
        self.compared.append((pairs[in_order], stored.compared.seen[in_order]))

    def stored(self) -> StoredMap:
        """All that was taken over."""
        arrays = {
            "poses": np.array(self.poses), "points": np.concatenate([np.empty((0, 3)), *self.points]),
            "component_of": np.zeros(len(self.poses), dtype=np.int64), "doubt": np.array(self.overconfidence),
            "ties": np.array(self.budgets, dtype=np.int64), "redundant": np.array(self.redundant, dtype=np.bool_),
        }  # fmt: skip
        state = stored_state(self.submaps, list(self.links.values()), arrays)
        pairs = np.concatenate([p for p, _ in self.compared])
        _, first = np.unique(pairs, axis=0, return_index=True)
        compared = Compared.of(pairs[first], np.concatenate([s for _, s in self.compared])[first])
        return StoredMap(state, self.pending, self.refused, compared, Marks(self.marks))


def _renumbered(links: Iterable[Link], record_of: dict[int, int]) -> list[Link]:
    return [replace(k, first=record_of[k.first], second=record_of[k.second]) for k in links]


def _free(name: str, taken: set[str], least: int = 1) -> str:
    """The name, or the first free one with a number."""
    if least == 1 and name not in taken:
        return name
    number = 2
    while f"{name}_{number}" in taken:
        number += 1
    return f"{name}_{number}"
