# SPDX-License-Identifier: Apache-2.0
"""The submaps of a map by agent: which follow each other, which is the newest, and in which order they come."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.map_graph import BUILDING
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.geometry import compose_covariance
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.types import PoseEstimate, Submap

Key = tuple[str, int, int]


@dataclass
class Agents:
    """Records of a map by agent, session and index; ``window``: how long a chain of them is asked for.

    chained (n, 2): each record with those of its chain, the earlier one first.
    """

    estimate: MapEstimate
    window: int
    chained: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    _lookup: dict[Key, int] = field(default_factory=dict)
    _newest: dict[str, int] = field(default_factory=dict)
    _odometry: dict[str, PoseEstimate] = field(default_factory=dict)

    def record(self, agent: str, session: int, index: int) -> int | None:
        """Number of a record, or None."""
        return self._lookup.get((agent, session, index))

    def newest(self, agent: str) -> int | None:
        """Number of the record that came last of an agent, or None."""
        return self._newest.get(agent)

    def chain(self, new: int) -> list[int]:
        """The records before ``new`` along its agent's odometry, newest first, as many as it may be linked to."""
        chain, (agent, session, index) = [new], self.estimate.graph.records[new].key
        while (
            len(chain) <= self.window
            and (previous := self.record(agent, session, index - 1)) is not None
            and self.estimate.graph.records[previous].end == self.estimate.graph.records[chain[-1]].start
        ):
            chain.append(previous)
            index -= 1
        return chain[1:]

    def odometry(self, agent: str) -> PoseEstimate:
        """End pose of an agent's newest submap in its own odometry frame: the chain of end poses of its session."""
        return self._odometry.get(agent, PoseEstimate(0, np.eye(4), np.zeros((6, 6))))

    def add(self, new: int) -> None:
        """Take notice of a new record and chain its agent's odometry on to it.

        Anew where the record begins a session or does not come in its turn.
        """
        record = self.estimate.graph.records[new]
        agent, session, index = record.key
        before, chain, known = self.newest(agent), [record.submap], self.odometry(agent)
        if before is None or self.estimate.graph.records[before].key != (agent, session, index - 1):
            own = [r.submap for r in self.estimate.graph.records if r.key[:2] == (agent, session)]
            chain, known = sorted(own, key=lambda s: s.index), PoseEstimate(0, np.eye(4), np.zeros((6, 6)))
        for s in chain:
            covariance = compose_covariance(known.T, known.covariance, s.end_pose, s.covariance[:6, :6])
            known = PoseEstimate(record.submap.end_stamp_ns, known.T @ s.end_pose, covariance)
        earlier = np.array([[previous, new] for previous in self.chain(new)], dtype=np.int64).reshape(-1, 2)
        self.chained = np.concatenate([self.chained, earlier])
        self._lookup[record.key], self._newest[agent], self._odometry[agent] = new, new, known


def in_order(submaps: Iterable[Submap]) -> list[Submap]:
    """Submaps as they come if none is late: by the stamps of their ends, each agent's in their own order.

    The last one of each agent comes after all others: it is closed when all input has ended. The building's comes
    first.
    """
    runs: dict[str, list[Submap]] = {}
    for submap in sorted(submaps, key=lambda s: (s.session, s.index)):
        runs.setdefault(submap.agent, []).append(submap)
    turns: list[tuple[bool, int, str, int, Submap]] = []
    for agent, run in runs.items():
        stamps = np.maximum.accumulate([s.end_stamp_ns for s in run]).tolist()
        ends = None if agent == BUILDING else run[-1]
        turns += [(s is ends, stamp, agent, k, s) for k, (stamp, s) in enumerate(zip(stamps, run, strict=True))]
    return [turn[-1] for turn in sorted(turns, key=lambda turn: turn[:4])]


def separate_parts(snapshot: MapSnapshot) -> str:
    """Parts of the map that no recognised place ties together yet, with the names of the agents in each."""
    agents: dict[int, set[str]] = {}
    for part, (agent, _, _) in zip(snapshot.part_of.tolist(), snapshot.keys, strict=True):
        agents.setdefault(part, set()).add(agent or "the rig")
    names = [" and ".join(sorted(of_part)) for of_part in agents.values()]
    return f"{len(names)} separate parts: {'; '.join(names)}"
