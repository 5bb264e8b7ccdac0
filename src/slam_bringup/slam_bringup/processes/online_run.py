# SPDX-License-Identifier: Apache-2.0
"""A bag through the real nodes: start them, play the bag no faster than they follow, record, stop, collect.

private domain -> nodes and recorder ready and connected -> player -> input has ended -> map saved -> nodes stopped
"""

from __future__ import annotations

import importlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.extras import GET_ROS
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.overrides import Overrides
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.node_graph import NodeGraph, plan_nodes, viewer_nodes
from slam_bringup.processes.processes import NodeCommand, NodeGroup, PrivateDomain, node_environment
from slam_bringup.processes.start_map import StartMap
from slam_core.messages import STATIC_TRANSFORMS_TOPIC
from slam_core.storage.files import atomic_text

START_TIMEOUT_S = 180.0
"""A cold start compiles kernels."""

_SERVICE_TIMEOUT_S = 300.0
_HURRIED_TIMEOUT_S, _HURRIED_STOP_S = 2.0, 4.0
"""Longest wait for each step of the end, and for the nodes, once somebody wants the run to end."""
_HOPELESS_AFTER_S = 15.0
"""A run in which no frame has reached a filter by then, while messages are rejected, never will."""
_LAST_REPORT_S = 1.5
"""Longest wait for the last diagnostics: every node reports once a second."""
_WINDOW = 4
_DONE = ("submaps joined", "localized", "not recognised", "rejected")
"""Counts of submaps that ``sjsam`` has done with."""
_SJSAM = "/sjsam"
_SAVE_MAP = f"{_SJSAM}/save_map"
_FINISH_MAP = f"{_SJSAM}/finish"


@dataclass(frozen=True, eq=False)
class OnlineRun:
    """Messages and files that the nodes left behind.

    recording: the bag of their topics. map_folder: the map that ``sjsam`` saved. diagnostics: last values by full node
    name. exit_codes: by full node name. wall_s: from the first message played to the last submap joined. stopped:
    whether it was told to end before the bag did.
    """

    recording: Path
    map_folder: Path
    diagnostics: dict[str, dict[str, str]]
    exit_codes: dict[str, int]
    wall_s: float
    stopped: bool = False


def run_nodes(
    bag: Path,
    config: SystemConfig,
    out: Path,
    *,
    logs: Path | None = None,
    odometry: bool,
    composed: bool = False,
    rate: float = 0.0,
    names: BagNames | None = None,
    overrides: Overrides | None = None,
    view_port: int = 0,
    start_map: StartMap | None = None,
    on_progress: Callable[[int], None] = lambda frames: None,
    stopped: Callable[[], bool] = lambda: False,
) -> OnlineRun:
    """Map a bag with the nodes of the workspace.

    Parameters
    ----------
    bag
        The bag to play.
    config
        Already adapted to mode, mapper and odometry by :func:`slam_bringup.pipeline.configuration.choose`.
    out
        New folder for the recording ``result.mcap`` and the map.
    logs
        Folder for the nodes' logs; by default ``logs`` in ``out``.
    odometry
        Whether scan odometry runs as well.
    composed
        Whether all nodes share one process instead of having one each.
    rate
        Speed of the replay; 0: as fast as the nodes follow. Nothing is lost either way.
    names
        Topics and frames of the bag that are not named like the nodes' own.
    overrides
        Where ``config`` is from: parameters that only the nodes have, or one agent's.
    view_port
        Port of a page that shows the nodes at work, with the dense model; 0: none.
    start_map
        Map of an earlier run to go on in, or to be located in.
    on_progress
        Called with the number of frames that the filters have processed.
    stopped
        Asked all the time: whether to end here, with what is mapped so far; KeyboardInterrupt if that is nothing yet.
        Where KeyboardInterrupt comes from outside the map is saved before it goes on.

    Raises
    ------
    ValueError
        If a node does not start, ends by itself, or does not answer; the message holds the end of its log.
    """
    with SensorBag(bag, names) as opened:
        graph = plan_nodes(
            config, opened.sensors, odometry, str(out / "map"), overrides, calibration=opened.calibration,
            start_map=start_map, mountings=opened.mountings,
        )  # fmt: skip
        viewers = viewer_nodes(config, opened.sensors, view_port) if view_port else []
    with PrivateDomain() as domain:
        environment = node_environment(domain)
        with NodeGroup(environment, logs or out / "logs") as group, _supervisor(environment, group) as supervisor:
            run = _Choreography(group, supervisor, graph, out, stopped)
            run.start_nodes(composed=composed)
            for viewer in viewers:
                group.start(viewer.command)
            started = time.monotonic()
            try:
                run.play(bag, rate, on_progress)
                run.finish()
            except KeyboardInterrupt:
                run.save_at_once()
                raise
            wall_s = time.monotonic() - started
            diagnostics = run.last_diagnostics()
            group.stop(*[_HURRIED_STOP_S] * stopped())
    return OnlineRun(out / "result.mcap", out / "map", diagnostics, group.exit_codes, wall_s, stopped())


def _supervisor(environment: dict[str, str], group: NodeGroup) -> Any:
    """The node that watches the others. ROS is imported here and not before, so that all else works without it."""
    try:
        module = importlib.import_module("slam_bringup.processes.supervisor_node")
    except ImportError as error:
        raise ValueError(f"the nodes need ROS 2 Jazzy ({error}): {GET_ROS}") from error
    return module.Supervisor(environment, group.check)


class _Choreography:
    """The steps of a run, in the order of its methods."""

    def __init__(
        self, group: NodeGroup, supervisor: Any, graph: NodeGraph, out: Path, stopped: Callable[[], bool]
    ) -> None:
        self._group = group
        self._supervisor = supervisor
        self._graph = graph
        self._recording = out / "result.mcap"
        self._stopped = stopped
        self._reports_before: dict[str, int] = {}

    def start_nodes(self, *, composed: bool) -> None:
        """All nodes and the recorder at once; returns when every topic has reached whoever listens to it."""
        for command in (*((self._composed(),) if composed else self._graph.commands), self._recorder()):
            self._group.start(command)
        self._wait_until_ready(from_outside=(*self._graph.played.values(), STATIC_TRANSFORMS_TOPIC))
        self._wait_for_recorder()

    def _composed(self) -> NodeCommand:
        """The process that is all nodes, which it finds in a file."""
        nodes = [(c.package, c.executable, c.arguments, c.namespace) for c in self._graph.commands]
        path = self._group.logs / "nodes.json"
        atomic_text(path, json.dumps(nodes, indent=1))
        return NodeCommand("slam_bringup", "slam_composed", ("--nodes", str(path)))

    def _wait_until_ready(self, from_outside: tuple[str, ...]) -> None:
        """All nodes have reported themselves with all inputs connected, but those that come ``from_outside``."""
        names = [command.full_name for command in self._graph.commands]
        obstacles = self._supervisor.obstacles
        try:
            self._supervisor.wait(
                lambda: self._stopped() or not obstacles(names, from_outside), START_TIMEOUT_S, "start of the nodes"
            )
        except TimeoutError as error:
            raise ValueError(f"{error}: {'; '.join(obstacles(names, from_outside))}") from None
        if self._stopped():
            raise KeyboardInterrupt

    def _recorder(self) -> NodeCommand:
        parameters = {"bag": str(self._recording), "topics": self._graph.recorded_topics, "header_stamps": True}
        return NodeCommand("slam_bags", "recorder", tuple(ros_arguments(parameters)))

    def _wait_for_recorder(self) -> None:
        topics = [t for t in self._graph.recorded_topics if self._supervisor.publishes(t)]
        recorded = self._supervisor.subscribers
        self._supervisor.wait(
            lambda: all("/recorder" in recorded(topic) for topic in topics), START_TIMEOUT_S, "start of the recorder"
        )

    def play(self, bag: Path, rate: float, on_progress: Callable[[int], None]) -> None:
        """Play the bag to its end; the player ends when the paced nodes have processed everything."""
        heard_topics = (*self._graph.played.values(), STATIC_TRANSFORMS_TOPIC)
        parameters = {
            "bag": str(bag),
            "rate": rate,
            "topics": tuple(self._graph.played),
            "pace": self._graph.pace,
            "rename": tuple(f"{topic}={name}" for topic, name in self._graph.played.items() if name != topic),
            "window": _WINDOW,
            "wait_for_start": True,
            "transforms": self._graph.transforms,
            "subscribers": tuple(f"{t}={len(self._supervisor.subscribers(t))}" for t in heard_topics),
        }
        player = self._group.start(NodeCommand("slam_bags", "bag_player", tuple(ros_arguments(parameters))))
        self._supervisor.count_submaps(f"{name.rpartition('/')[0]}/submap/info" for name in self._graph.filters)
        self._supervisor.prepare((*(f"{name}/finish" for name in self._graph.finishers), _FINISH_MAP, _SAVE_MAP))
        self._wait_until_ready(from_outside=())
        heard = self._supervisor.progress.total
        self._supervisor.call("/bag_player/start", has_effect=lambda: heard() > 0 or not player.is_running)
        started = time.monotonic()
        while player.is_running:
            self._supervisor.listen(0.2)
            frames = sum(self._supervisor.progress[name] for name in self._graph.filters)
            on_progress(frames)
            if self._stopped():
                player.interrupt()
            elif frames == 0 and time.monotonic() > started + _HOPELESS_AFTER_S:
                self._require_hope()
        self._group.check()

    def _require_hope(self) -> None:
        """Refuse to go on where nodes reject their input and nothing arrives; the message holds what they say."""
        rejecting = [
            name for name, values in self._supervisor.diagnostics.items() if values.get("rejected", "0") != "0"
        ]
        complaints = [
            f"{node.command.full_name}: {line}"
            for node in self._group.nodes
            if node.command.full_name in rejecting and (line := node.last_line("rejected"))
        ]
        if complaints:
            raise ValueError(f"no frame has reached the filter: {'; '.join(complaints)}. What does slam doctor say?")

    def finish(self) -> None:
        """Tell the nodes that the input has ended, front to back, and have the map saved when all is joined."""
        filters = self._graph.filters
        self._reports_before = dict(self._supervisor.reports)
        for names in ([name for name in self._graph.finishers if name not in filters], filters):
            for name in names:
                self._patiently(partial(self._supervisor.call, f"{name}/finish"))
            self._supervisor.wait_until_quiet(self._limit_s)
        self._patiently(partial(self._supervisor.wait, self._all_joined, what="joining of the last submap"))
        self._patiently(partial(self._supervisor.call, _FINISH_MAP))
        self._supervisor.call(_SAVE_MAP, _SERVICE_TIMEOUT_S)

    def save_at_once(self) -> None:
        """Have the map saved as it is, if there is any and that is quick."""
        values = self._supervisor.diagnostics.get(_SJSAM, {})
        if any(int(values.get(key, "0")) for key in _DONE[:2]):
            with suppress(TimeoutError, ValueError):
                self._supervisor.call(_SAVE_MAP, _HURRIED_TIMEOUT_S)

    @property
    def _limit_s(self) -> float:
        return _HURRIED_TIMEOUT_S if self._stopped() else _SERVICE_TIMEOUT_S

    def _patiently(self, step: Callable[[float], object]) -> None:
        """Do a step of the end; one that a user is in too much of a hurry for is left out, the map is saved anyway."""
        try:
            step(self._limit_s)
        except TimeoutError:
            if not self._stopped():
                raise

    def last_diagnostics(self) -> dict[str, dict[str, str]]:
        """The final values of the nodes that map, once they have reported after the end; a page's own are none."""
        names = [command.full_name for command in self._graph.commands]
        self._supervisor.wait_for_reports(names, self._reports_before, _LAST_REPORT_S)
        return {name: self._supervisor.diagnostics[name] for name in names if name in self._supervisor.diagnostics}

    def _all_joined(self) -> bool:
        values = self._supervisor.diagnostics.get(_SJSAM, {})
        joined = sum(int(values.get(key, "0")) for key in _DONE)
        return joined >= int(self._supervisor.submaps)


def unclean_ends(run: OnlineRun) -> list[str]:
    """Nodes that did not end with exit code 0."""
    return [f"{name} ended with code {code}" for name, code in sorted(run.exit_codes.items()) if code != 0]
