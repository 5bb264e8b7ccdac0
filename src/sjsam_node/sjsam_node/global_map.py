"""The map of all agents: submaps go in one by one, a consistent map and trajectories with covariances come out.

    global_map = GlobalMap(GlobalMapConfig())
    for submap in submaps:
        report = global_map.add(submap)

:meth:`GlobalMap.add` reads as Algorithm 4 does: place the submap, associate, join; and beyond it: look for closures,
judge them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

from sjsam_node import map_view, storage
from sjsam_node.closures import ClosureConfig, LinkFinder
from sjsam_node.estimator import Assembled
from sjsam_node.joiner import Joiner, JoinerConfig
from sjsam_node.map_graph import Link, MapGraph
from sjsam_node.marks import Marks
from sjsam_node.storage import StoredMap
from sjsam_node.trial import TrialConfig, Trials, Verdict
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray, invert_transform, is_rigid_transform
from slam_core.types import Counters, PoseEstimate, Submap


@dataclass(frozen=True)
class GlobalMapConfig(Config):
    """The joined map."""

    unlinked_sigma: float = parameter(
        100.0, "standard deviation given to poses of a stretch that nothing ties to the map yet", unit="m", minimum=1.0
    )
    compared_at_once: int = parameter(
        60, "pairs of submaps that a closure has brought near each other, compared before the next submap", minimum=0
    )
    joining: JoinerConfig = group(JoinerConfig)
    closure: ClosureConfig = group(ClosureConfig)
    trial: TrialConfig = group(TrialConfig)


@dataclass(frozen=True, eq=False)
class JoinReport:
    """What became of one submap.

    accepted with reason otherwise; matched: its landmarks already in the map; new_landmarks; closures: links believed
    now, as (agent, index) of the older submap; dropped_links: links taken back; components: parts of the map that
    hang together; chi2, iterations, converged and solver of the joining; update: ``batch``, ``incremental`` or
    ``odometry``.
    """

    accepted: bool
    reason: str = ""
    matched: int = 0
    new_landmarks: int = 0
    closures: tuple[tuple[str, int], ...] = ()
    dropped: int = 0
    components: int = 0
    chi2: float = 0.0
    iterations: int = 0
    converged: bool = True
    solver: str = ""
    update: str = ""


class GlobalMap:
    """Joins submaps of one or several agents, each as it comes."""

    graph: MapGraph
    finder: LinkFinder
    joiner: Joiner
    trials: Trials
    marks: Marks

    def __init__(self, config: GlobalMapConfig | None = None) -> None:
        self.config = config or GlobalMapConfig()
        self.counters = Counters()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.graph = MapGraph()
        self.marks = Marks()
        self.finder = LinkFinder(self.config.closure)
        self.joiner = Joiner(self.graph, self.config.closure.window, self.config.joining)
        self.trials = Trials(self.joiner, self.config.trial, self.config.closure)
        self._lookup: dict[tuple[str, int, int], int] = {}
        self._unsearched: list[int] = []
        self._closed_at = 0

    def add(self, submap: Submap) -> JoinReport:
        """Join one submap; a faulty one is refused with the reason, counted, and changes nothing."""
        reason = self._fault(submap)
        if reason:
            self.counters.add(f"refused: {reason}")
            return JoinReport(False, reason)
        new = self._place(submap)
        chain = self._chain(new)
        for link in self.finder.sequential(self.graph, chain, new):
            self.graph.add_link(link)
        joined = self.joiner.absorb(new, chain)
        matched = self._matched(new)
        self._unsearched.append(new)
        closures, dropped = self._close_loops() if self._is_search_due(new) else ([], 0)
        self.finder.index.add(new, submap.descriptors)
        return JoinReport(
            True, "", matched, len(submap.landmarks) - self._matched(new), tuple(closures), dropped, self.components,
            self.joiner.cost(self.graph.component(new)), joined.iterations, joined.converged, joined.solver,
            "batch" if closures else joined.update,
        )  # fmt: skip

    @property
    def components(self) -> int:
        """Parts of the map that nothing ties together yet."""
        return len(np.unique(self.graph.component_of))

    def _fault(self, submap: Submap) -> str:
        """Why a submap cannot be joined; empty if it can."""
        if not (np.all(np.isfinite(submap.covariance)) and np.all(np.isfinite(submap.landmarks))):
            return "not finite"
        if not is_rigid_transform(submap.end_pose):
            return "end pose is not a rigid transform"
        try:
            np.linalg.cholesky(submap.covariance)
        except np.linalg.LinAlgError:
            return "covariance is not positive definite"
        known = self.graph.records[0].submap.descriptors.shape[1] if self.graph.records else None
        if known is not None and submap.descriptors.shape[1] != known and len(submap.landmarks):
            return f"descriptors of {submap.descriptors.shape[1]} columns in a map of {known}"
        held = self._lookup.get((submap.agent, submap.session, submap.index))
        if held is None:
            return ""
        same = self.graph.records[held].submap.start_stamp_ns == submap.start_stamp_ns
        return "already joined" if same else "another submap of this agent, session and index is in the map"

    def _place(self, submap: Submap) -> int:
        """Add a record at the end of its predecessor, or as a component of its own where the agent was last seen."""
        previous = self._lookup.get((submap.agent, submap.session, submap.index - 1))
        follows = submap.follows_previous and previous is not None
        start = self.graph.records[previous].end if follows and previous is not None else None
        self.graph.append(submap, start, self._last_pose(submap.agent))
        new = len(self.graph.records) - 1
        self._lookup[self.graph.records[new].key] = new
        return new

    def _last_pose(self, agent: str) -> FloatArray:
        """Where an agent was last; the origin for one not seen before."""
        newest = next((r for r in reversed(self.graph.records) if r.submap.agent == agent), None)
        return np.eye(4) if newest is None else self.graph.poses[newest.end]

    def _chain(self, new: int) -> list[int]:
        """The last records before ``new`` along its agent's odometry, newest first, as many as it may be linked to."""
        chain: list[int] = []
        agent, session, index = self.graph.records[new].key
        while (
            len(chain) < self.config.closure.window
            and (previous := self._lookup.get((agent, session, index - 1))) is not None
            and (self.graph.records[previous].end == self.graph.records[self._lookup[agent, session, index]].start)
        ):
            chain.append(previous)
            index -= 1
        return chain

    def _matched(self, new: int) -> int:
        """Landmarks of a record that another record sees too."""
        return int(self.graph.shared()[self.graph.records[new].observations].sum())

    def _is_search_due(self, new: int) -> bool:
        """A revisit closes again and again at the cost of a batch; the larger the map, the fewer of these at once."""
        size = self.graph.size(self.graph.component(new))
        interval = 1 if size <= self.config.joining.incremental_from else 1 + int(np.sqrt(size) / 3.0)
        return len(self.graph.records) - self._closed_at >= interval

    def _close_loops(self) -> tuple[list[tuple[str, int]], int]:
        """Look for closures of the submaps not looked at yet; believe those that the joined map can live with."""
        unsearched, self._unsearched = self._unsearched, []
        links: list[Link] = []
        contradicted: list[Link] = []
        for new in unsearched:
            found = self.finder.closures(self.graph, self._chain(new), new, self.joiner.relative_pose)
            links += found.believed
            contradicted += found.contradicted
        verdict = self.trials.hear(links, contradicted, unsearched[-1]) if links or contradicted else Verdict()
        if verdict.believed:
            verdict = verdict.followed_by(self._catch_up(unsearched[-1], self.config.compared_at_once))
        for name, amount in (
            ("closures refused by the joined map", len(links) if not verdict.believed else 0),
            ("matches taken back", verdict.dropped),
            ("closures taken back", len(verdict.revoked)),
        ):
            if amount:
                self.counters.add(name, amount)
        self.finder.near.forget({i for k in verdict.revoked for i in (k.first, k.second)})
        if verdict.believed:
            self._closed_at = len(self.graph.records)
        older = [self.graph.records[link.first].submap for link in verdict.believed]
        return [(submap.agent, submap.index) for submap in older], verdict.dropped

    def _catch_up(self, newest: int, most: int | None) -> Verdict:
        """Compare what has come near each other, ``most`` pairs at once, until nothing new is believed."""
        total = Verdict()
        while True:
            missed = self.finder.missed(self.graph, self._chain, self.joiner.relative_pose, most)
            if not missed.believed:
                return total
            verdict = self.trials.hear(missed.believed, missed.contradicted, newest)
            total = total.followed_by(verdict)
            if not verdict.believed:
                return total

    @overload
    def trajectory(self) -> dict[str, list[PoseEstimate]]: ...

    @overload
    def trajectory(self, agent: str) -> list[PoseEstimate]: ...

    def trajectory(self, agent: str | None = None) -> dict[str, list[PoseEstimate]] | list[PoseEstimate]:
        """Rig poses in the map frame with covariances (see :func:`sjsam_node.map_view.trajectory`).

        Of every agent by name, or of one.
        """
        trajectories = map_view.trajectory(self)
        return trajectories if agent is None else trajectories.get(agent, [])

    def landmarks(self) -> map_view.MapLandmarks:
        """Every landmark once, with covariance, descriptor and id."""
        return map_view.landmarks(self)

    def settle(self) -> None:
        """Do now what was put off: look for closures, compare what has come near, and join in batch.

        Reading the map does not: what is believed does not depend on who looks when.
        """
        if self._unsearched:
            self._close_loops()
        if self.graph.records:
            self._join_whole()
            self._catch_up(len(self.graph.records) - 1, None)
        self._join_whole()

    def _join_whole(self) -> None:
        for component in np.unique(self.graph.component_of):
            self.joiner.assembled(int(component))

    def centrally(self) -> GlobalMap:
        """The map that does not depend on who came first: all submaps joined anew, agent after agent, and settled.

        The map itself where they came in that order; otherwise it costs as much as they did when they came.
        """
        records, central = self.graph.records, self
        order = sorted(range(len(records)), key=lambda i: records[i].key)
        if order != list(range(len(records))):
            central = GlobalMap(self.config)
            for record in (records[i] for i in order):
                central.add(record.submap)
            central.counters = self.counters
            central.marks = self._marks_in(central)
        central.settle()
        return central

    def _marks_in(self, other: GlobalMap) -> Marks:
        """The marks of this map, on the nodes of another one of the same submaps."""
        node = {}
        for record in self.graph.records:
            twin = other.graph.records[other._lookup[record.key]]
            node[record.start], node[record.end] = twin.start, twin.end
        return Marks([replace(mark, node=node[mark.node]) for mark in self.marks.marks])

    def map_to_odom(self, agent: str) -> FloatArray:
        """T_map_odom of an agent: what its newest joined pose adds to its own odometry (chained submap end poses)."""
        own = [r for r in self.graph.records if r.submap.agent == agent]
        if not own:
            return np.eye(4)
        return np.asarray(self.graph.poses[own[-1].end] @ invert_transform(self.odometry_pose(agent)))

    def odometry_pose(self, agent: str) -> FloatArray:
        """End pose of an agent's newest submap in its own odometry frame: the chain of end poses of its current run."""
        own = [r.submap for r in self.graph.records if r.submap.agent == agent]
        T = np.eye(4)
        for submap in sorted((s for s in own if s.session == own[-1].session), key=lambda s: s.index):
            T = T @ submap.end_pose
        return T

    def assembled(self, component: int) -> Assembled:
        """The joining problem of a component, everything in it, at its optimum."""
        return self.joiner.assembled(component)

    def start_pose(self, record: int) -> PoseEstimate:
        """Start pose of a record in the map frame, with covariance."""
        r = self.graph.records[record]
        return PoseEstimate(r.submap.start_stamp_ns, self.graph.poses[r.start], self._covariance(r.start))

    def _covariance(self, node: int) -> FloatArray:
        """Covariance (6, 6) of a node, honest as :mod:`sjsam_node.map_view` says."""
        component = int(self.graph.component_of[node])
        return self.joiner.variance_factor(component) * self.assembled(component).covariance([node])

    def end_pose(self, agent: str) -> PoseEstimate | None:
        """Where an agent's newest submap ends in the map frame; None for one not heard of."""
        own = [i for i, r in enumerate(self.graph.records) if r.submap.agent == agent]
        if not own:
            return None
        r = self.graph.records[own[-1]]
        return PoseEstimate(r.submap.end_stamp_ns, self.graph.poses[r.end], self._covariance(r.end))

    def save(self, path: Path | str) -> None:
        """Write the map to a folder (see :mod:`sjsam_node.storage`), and go on from it as a map that is loaded does."""
        self.settle()
        stored = StoredMap(
            self.graph,
            self.finder.pending,
            self.trials.contested,
            self.finder.near.compared,
            self.marks,
            self._closed_at,
        )
        storage.write(Path(path), stored)
        self.joiner.forget()

    @classmethod
    def load(cls, path: Path | str, config: GlobalMapConfig | None = None) -> GlobalMap:
        """The map that :meth:`save` wrote; ``ValueError`` if the folder is no such map."""
        stored = storage.read(Path(path))
        loaded, graph = cls(config), stored.graph
        loaded.graph, loaded.marks, loaded._closed_at = graph, stored.marks, stored.closed_at
        loaded.joiner = Joiner(graph, loaded.config.closure.window, loaded.config.joining)
        loaded.trials = Trials(loaded.joiner, loaded.config.trial, loaded.config.closure, stored.contested)
        loaded.finder.pending, loaded.finder.near.compared = stored.pending, stored.compared
        for i, record in enumerate(graph.records):
            loaded._lookup[record.key] = i
            loaded.finder.index.add(i, record.submap.descriptors)
        return loaded
