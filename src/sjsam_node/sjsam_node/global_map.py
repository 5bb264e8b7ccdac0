# SPDX-License-Identifier: Apache-2.0
"""The map of all agents: submaps go in one by one, a consistent map and trajectories with covariances come out.

    global_map = GlobalMap(GlobalMapConfig())
    for submap in submaps:
        report = global_map.add(submap)

:meth:`GlobalMap.add` reads as Algorithm 4 does: place the submap, associate, join; and beyond it: look for closures and
keep those that the map can live with. Only ``add``, ``settle``, ``save`` and ``reset`` change the map; what is read
comes from a :class:`~sjsam_node.smoothing.map_snapshot.MapSnapshot`, which stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np

from sjsam_node.agents import Agents, in_order
from sjsam_node.consistency.closure_joining import ClosureJoiner, grouped
from sjsam_node.consistency.conditions import Verdict
from sjsam_node.global_map_config import GlobalMapConfig as GlobalMapConfig
from sjsam_node.graph.links import Link, Status
from sjsam_node.graph.map_graph import BUILDING, POSITIONS
from sjsam_node.graph.marks import Marks
from sjsam_node.graph.offload import Offload
from sjsam_node.join_report import JoinReport as JoinReport
from sjsam_node.loop_closure.comparing import RecordComparisons
from sjsam_node.loop_closure.detector import LoopDetector
from sjsam_node.loop_closure.verification import LINKED_SUBMAPS
from sjsam_node.map_file import storage
from sjsam_node.map_file.refining import lacking, refined
from sjsam_node.map_file.storage import StoredMap
from sjsam_node.positions.antenna import seen_inside, with_antenna
from sjsam_node.positions.position_links import PositionLinks, readings_of, without_antenna
from sjsam_node.regions.tasks import Tasks
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.smoothing.map_snapshot import InnerPaths, MapLandmarks, MapSnapshot
from sjsam_node.smoothing.solver import updated
from sjsam_node.smoothing.state import EstimateState
from sjsam_node.submap_check import fault_of
from sjsam_node.tags.known_tags import building_submap
from sjsam_node.tags.tag_links import TagLinks, is_against_tags, with_tag_links
from slam_core.geometry import FloatArray, invert_transform
from slam_core.types import Counters, PoseEstimate, PositionReading, Submap

ALREADY_JOINED = "already joined"

_PASSES = 2
"""Times that settling looks for closures, and lets go what the map contradicts: one finding lets another follow."""

_COMPARED_AT_ONCE = 2
"""Pairs of submaps that a closure has brought near each other, compared with each new submap."""
_COMPARED_AT_SETTLING = 2
"""Such pairs compared per submap when the map settles."""
_UNLINKED_SIGMA = 100.0
"""Standard deviation given to poses of a stretch that nothing ties to the map yet (m)."""


class GlobalMap:
    """Joins submaps of one or several agents, each as it comes; ``tasks`` do parts of it, which change no byte."""

    estimate: MapEstimate
    agents: Agents
    detector: LoopDetector
    closures: ClosureJoiner
    marks: Marks

    def __init__(self, config: GlobalMapConfig | None = None, tasks: Tasks | None = None) -> None:
        self.config, self._tasks = config or GlobalMapConfig(), tasks
        self.counters = Counters()
        self._known_tags = self.config.tags.known_tags()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._take(EstimateState())
        self.marks = Marks()
        self._offload = Offload()
        self._has_moved, self._is_settled, self._is_out_of_order = False, True, False

    def _take(self, state: EstimateState) -> None:
        """Go on from a state."""
        self.estimate = MapEstimate(self.config.smoothing, state, self._tasks)
        self.agents = Agents(self.estimate, LINKED_SUBMAPS)
        self.detector = LoopDetector(self.estimate, self.config.closure)
        if self._tasks is not None:
            self.detector.compare = RecordComparisons(self.estimate, self.config.closure, self._tasks)
        self.closures = ClosureJoiner(self.estimate, self.config.consistency, self.config.closure)
        self.tags = TagLinks(self.estimate, self.detector.verifier)
        self.positions = PositionLinks(self.estimate, self.detector.verifier, self.counters)
        self.detector.is_refuted = lambda *pair_and_found: is_against_tags(self.estimate.graph, *pair_and_found)
        self._inner_paths, self._paged_out = InnerPaths(), 0

    @property
    def state(self) -> EstimateState:
        """The state of the estimate."""
        return self.estimate.state

    def snapshot(self) -> MapSnapshot:
        """The map as it is now, for those who read it."""
        marks = Marks(list(self.marks.marks))
        return MapSnapshot(self.state, _UNLINKED_SIGMA, self.config.calibration, marks, self._inner_paths)

    def add(self, submap: Submap, readings: Sequence[PositionReading] = ()) -> JoinReport:
        """Join one submap; a faulty one is refused with the reason, counted, and changes nothing.

        ``readings``: positions in a fixed frame that were measured inside it.
        """
        reason = self._rejection(submap)
        if reason == ALREADY_JOINED and (known := lacking(self.estimate.graph, submap)) is not None:
            return self._refine(known, submap)
        if reason:
            self.counters.add(f"refused: {reason}")
            return JoinReport(False, reason)
        self._is_out_of_order |= self._is_settled and bool(self.estimate.graph.records)
        self._is_settled = False
        self._place_building(submap.descriptors.shape[1])
        readings = seen_inside(submap, readings)
        submap = with_antenna(submap, readings, np.array(self.config.position.lever_arm))
        new = self._place(submap)
        self.positions.add(new, readings)
        chain = self.agents.chain(new)
        self.estimate.add_links(with_tag_links(self.detector.sequential(chain, new), self.tags.sequential(chain, new)))
        matched = self.estimate.graph.shared_by(new)
        with self.estimate.condensing(new, chain):
            found = with_tag_links(self.detector.closures(chain, new), self.tags.closures(chain, new))
            if self._has_moved:
                found += self.detector.missed(self.agents.chained, _COMPARED_AT_ONCE)
        self._join_positions(new, before_others=bool(found))
        self._judge_redundancy(new, found)
        verdict = self.closures.join_closures(found, new)
        self._account(verdict, len(found))
        surprising = any(k.status is not Status.CONSISTENT for k in found) and bool(verdict.accepted)
        self._has_moved = surprising or bool(verdict.removed) or (self._has_moved and bool(found))
        is_redundant = bool(self.state.is_redundant(new))
        if not is_redundant:
            self.detector.index.add(new, submap.descriptors)
        self._page_out(new + 1 - LINKED_SUBMAPS)
        result, shared = self.state.result(self.state.component(new)), self.estimate.graph.shared_by(new)
        return JoinReport(
            True, "", matched, len(submap.landmarks) - shared, self._named(verdict.accepted), verdict.dropped,
            self.components, result.cost, result.variance_factor, result.iterations, result.converged, result.solver,
            is_redundant, result.variance_factor > self.config.consistency.max_variance_factor,
        )  # fmt: skip

    def _refine(self, record: int, submap: Submap) -> JoinReport:
        """Take further landmarks of a submap in, and compare it anew with what it may be the same place as."""
        before = len(self.estimate.graph.records[record].submap.landmarks)
        self._restore(refined(self.stored(), record, submap))
        found = self.detector.again(record, self.agents.chain(record))
        verdict = self.closures.join_closures(found, len(self.estimate.graph.records) - 1)
        self._account(verdict, len(found))
        self._has_moved |= bool(verdict.accepted)
        return JoinReport(True, "", 0, len(submap.landmarks) - before, self._named(verdict.accepted),
                          components=self.components, is_refined=True)  # fmt: skip

    def _join_positions(self, new: int, *, before_others: bool) -> None:
        """Take in what has been measured in a fixed frame; ``before_others``: closures are judged by what it says."""
        made = self.positions.join(new)
        for record in made:
            self.agents.add(record)
        if made and before_others:
            self.estimate.accept(updated(self.estimate.state, new, [], [], self.estimate.config))

    def _judge_redundancy(self, new: int, found: list[Link]) -> None:
        """A submap of a place that the map knows well adds few unknowns, and nothing is compared with it later."""
        known = [k.pairs[:, 1] for k in found if k.second == new and k.status is Status.CONSISTENT]
        count = len(np.unique(np.concatenate(known))) if known else 0
        share = self.config.redundant_share * len(self.estimate.graph.records[new].observations)
        if count > max(share, self.config.redundant_matches):
            self.estimate.mark_redundant(new)

    def _account(self, verdict: Verdict, found: int) -> None:
        """Count what became of closures, and compare anew what they let go."""
        for name, amount in (
            ("closures refused by the joined map", found if not verdict.accepted else 0),
            ("matches let go", verdict.dropped),
            ("closures let go", len(verdict.removed)),
        ):
            if amount:
                self.counters.add(name, amount)
        self.detector.near.forget({i for k in verdict.removed for i in k.ends})

    def _named(self, links: tuple[Link, ...]) -> tuple[tuple[str, int], ...]:
        older = [self.estimate.graph.records[link.first].submap for link in links]
        return tuple((submap.agent, submap.index) for submap in older)

    def _page_out(self, before: int) -> None:
        """Keep the large arrays of all submaps before a record on disk from here on."""
        for old in range(self._paged_out, before):
            record, put = self.estimate.graph.records[old], self._offload.put
            submap = record.submap
            on_the_way = put(np.array([p.covariance for p in submap.path]))
            path = tuple(replace(p, covariance=c) for p, c in zip(submap.path, on_the_way, strict=True))
            small = replace(submap, covariance=put(submap.covariance), descriptors=put(submap.descriptors), path=path)
            self.estimate.replace_record(old, replace(record, submap=small))
            self.detector.index.move(old, small.descriptors)
            self._offload.forget()
        self._paged_out = max(self._paged_out, before)

    @property
    def components(self) -> int:
        """Parts of the map that nothing ties together yet."""
        return len(self.state.components())

    def _rejection(self, submap: Submap) -> str:
        """Reason for which a submap cannot be joined; empty if it can."""
        if fault := fault_of(submap):
            return fault
        known = self.estimate.graph.records[0].submap.descriptors.shape[1] if self.estimate.graph.records else None
        if known is not None and submap.descriptors.shape[1] != known and len(submap.landmarks):
            return f"descriptors of {submap.descriptors.shape[1]} columns in a map of {known}"
        held = self.agents.record(submap.agent, submap.session, submap.index)
        if held is None:
            return ""
        same = self.estimate.graph.records[held].submap.start_stamp_ns == submap.start_stamp_ns
        return ALREADY_JOINED if same else "another submap of this agent, session and index is in the map"

    def _place(self, submap: Submap) -> int:
        """Add a record at the end of its predecessor, or as a component of its own where the agent was last seen."""
        previous = self.agents.record(submap.agent, submap.session, submap.index - 1)
        follows = submap.follows_previous and previous is not None
        start = self.estimate.graph.records[previous].end if follows and previous is not None else None
        new = self.estimate.add_submap(submap, start, self.last_pose(submap.agent), self.config.ties)
        self.agents.add(new)
        self.tags.add(new)
        return new

    def _place_building(self, columns: int) -> None:
        """Add the tags of which the user knows where they are, before the first submap that has come since."""
        if self._known_tags and self.agents.newest(BUILDING) is None:
            self._place(building_submap(self._known_tags, columns))

    def last_pose(self, agent: str) -> FloatArray:
        """Last pose of an agent, (4, 4); the origin for one not seen before."""
        newest = self.agents.newest(agent)
        return np.eye(4) if newest is None else self.state.end(newest)

    @overload
    def trajectory(self) -> dict[str, list[PoseEstimate]]: ...

    @overload
    def trajectory(self, agent: str) -> list[PoseEstimate]: ...

    def trajectory(self, agent: str | None = None) -> dict[str, list[PoseEstimate]] | list[PoseEstimate]:
        """Rig poses in the map frame with covariances (see :meth:`MapSnapshot.trajectory`).

        Of every agent by name, or of one.
        """
        trajectories = self.snapshot().trajectory()
        return trajectories if agent is None else trajectories.get(agent, [])

    def path(self) -> dict[str, list[PoseEstimate]]:
        """Poses of the trajectory by agent, with no more covariance than inside their submaps; costs little."""
        return self.snapshot().path()

    def landmarks(self) -> MapLandmarks:
        """Every landmark once, with covariance, descriptor and id."""
        return self.snapshot().landmarks()

    def settle(self) -> None:
        """Do now what was put off: compare what has come near, let go what does not fit, and join in batch.

        A map to which nothing was added since is settled already.
        """
        if self._is_settled:
            return
        for record in self.positions.look_again():
            self._join_positions(record, before_others=True)
        newest = len(self.estimate.graph.records) - 1
        for _ in range(_PASSES):
            missed = self.detector.missed(self.agents.chained, _COMPARED_AT_SETTLING * len(self.estimate.graph.records))
            for found in grouped(missed, self.config.joined_at_once):
                self._account(self.closures.join_closures(found, newest), len(found))
            if not missed:
                break
        for _ in range(_PASSES):
            self.estimate.optimize_full(coarse=True)
            verdict = self.closures.remove_contradicted(newest)
            self._account(verdict, 0)
            if not verdict.removed and not verdict.dropped:
                break
        self.estimate.optimize_full()
        self._account(self.closures.resolve_overconfidence(), 0)
        self.estimate.relinearize()  # from here on it says the same as one that is saved and loaded
        self._offload.forget()
        self._has_moved, self._is_settled = False, True

    def rebuilt_in_time_order(self) -> GlobalMap:
        """The settled map that does not depend on who came first: all submaps joined in the order of their stamps.

        The map itself where they came in that order, and nothing was settled on the way; otherwise all are joined anew.
        """
        submaps, rebuilt = [r.submap for r in self.estimate.graph.records if not r.is_position], self
        ordered = in_order(submaps)
        if self._is_out_of_order or ordered != submaps:
            rebuilt = GlobalMap(self.config, self._tasks)
            for submap in ordered:
                rebuilt.add_again(without_antenna(submap), self._readings_in(submap))
            rebuilt.counters.counts = self.counters.counts
            rebuilt.marks = self.marks_in(rebuilt)
        rebuilt.settle()
        return rebuilt

    def _readings_in(self, submap: Submap) -> tuple[PositionReading, ...]:
        """The positions inside a submap that were not refused."""
        record = self.agents.record(submap.agent, submap.session, submap.index)
        made = self.agents.record(POSITIONS + submap.agent, submap.session, submap.index)
        waiting = () if record is None else self.positions.waiting.get(record, ())
        return waiting if made is None else readings_of(self.estimate.graph.records[made].submap)

    def add_again(self, submap: Submap, readings: Sequence[PositionReading] = ()) -> None:
        """Join a submap that was in a map before; the tags of the building are placed as they were."""
        if submap.agent == BUILDING:
            self._place(submap)
        else:
            self.add(submap, readings)

    def marks_in(self, other: GlobalMap) -> Marks:
        """The marks of this map, on the nodes of another one of the same submaps."""
        node = {}
        for record in self.estimate.graph.records:
            twin = other.estimate.graph.records[other.agents.record(*record.key) or 0]
            node[record.start], node[record.end] = twin.start, twin.end
        return Marks([replace(mark, node=node[mark.node]) for mark in self.marks.marks])

    def map_to_odom(self, agent: str) -> FloatArray:
        """T_map_odom of an agent: what its newest joined pose adds to its own odometry (chained submap end poses)."""
        return np.asarray(self.last_pose(agent) @ invert_transform(self.odometry_pose(agent).T))

    def odometry_pose(self, agent: str) -> PoseEstimate:
        """End pose of an agent's newest submap in its own odometry frame."""
        return self.agents.odometry(agent)

    def end_pose(self, agent: str) -> PoseEstimate | None:
        """End of an agent's newest submap in the map frame; None for an agent not heard of."""
        newest = self.agents.newest(agent)
        return None if newest is None else self.snapshot().end(newest)

    def save(self, path: Path | str, *, is_last: bool = False) -> None:
        """Write the map to a folder (see :mod:`sjsam_node.map_file.storage`), and go on from it as a loaded map does.

        ``is_last``: nobody adds to the map or asks for covariances any more, so that only its graph is kept.
        """
        self.settle()
        if is_last:
            self.estimate.release_factors()
        storage.write(Path(path), self.stored())
        if is_last:
            self._offload.forget()

    def stored(self) -> StoredMap:
        """The map as it is, to be written; nothing is settled."""
        return StoredMap(
            self.state, self.detector.pending, self.closures.refused, self.detector.near.compared, self.marks,
            self._is_out_of_order, dict(self.positions.waiting),
        )  # fmt: skip

    @classmethod
    def load(cls, path: Path | str, config: GlobalMapConfig | None = None, tasks: Tasks | None = None) -> GlobalMap:
        """The map that :meth:`save` wrote; ``ValueError`` if the folder is no such map."""
        loaded = cls(config, tasks)
        loaded._restore(storage.read(Path(path)))
        return loaded

    def _restore(self, stored: StoredMap) -> None:
        """Go on from a map that was put away."""
        self._take(stored.state)
        self.positions.waiting = dict(stored.waiting)
        self._is_settled, self._is_out_of_order = not stored.state.graph.records, stored.is_out_of_order
        self.marks, self.closures.refused = stored.marks, stored.refused
        self.detector.pending, self.detector.near.compared = stored.pending, stored.compared
        for i, record in enumerate(stored.state.graph.records):
            self.agents.add(i)
            self.tags.add(i)
            if not stored.state.is_redundant(i):
                self.detector.index.add(i, record.submap.descriptors)
            self._page_out(i + 1)
        self.estimate.relinearize()
