# SPDX-License-Identifier: Apache-2.0
"""How late are poses live, how many frames are left out and where, how good is the map? Separate nodes or one process.

    python benchmarks/ros/latency.py BAG [--rate 1.0] [--mode fuse] [--odometry ndt] [--composed] [--seconds 60]

Plays the bag without waiting for the nodes. The lag of a frame is the time from its camera info, which is sent with its
image, to its pose on ``odom``, both as this process receives them; that of a node is up to its word that it is done
with a frame that has a pose. Then the nodes finish and save the map. Accuracy is the ATE against the bag's truth
of all that was played. CPU: of the nodes from the end of ``--settle`` to the last frame, per pose.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from sjsam_node.global_map import GlobalMap
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.node_graph import NodeGraph, plan_nodes
from slam_bringup.processes.online_run import START_TIMEOUT_S
from slam_bringup.processes.processes import NodeCommand, NodeGroup, NodeProcess, PrivateDomain, node_environment
from slam_bringup.processes.supervisor_node import Supervisor
from slam_core.evaluation import evaluate
from slam_core.messages import estimate_from_message, stamp_ns
from slam_core.nodes.base_node import PROGRESS_TOPIC
from slam_core.ros import RosTypes, sensor_qos
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate

_COUNTERS = ("skipped", "unpaired", "missing", "lost_by_transport", "rejected", "faults")
_AFTER_S = 3.0
"""Poses may come for so long after the last image."""


class Stopwatch:
    """When the stamp of each image, of each pose and of each node's progress was received, s."""

    def __init__(self, supervisor: Supervisor, image_info: str) -> None:
        self.sent: dict[int, float] = {}
        self.received: dict[int, float] = {}
        self.progress: dict[str, dict[int, float]] = defaultdict(dict)
        self.odometry: list[PoseEstimate] = []
        types, node = RosTypes(), supervisor._node
        for kind, topic, callback in (
            (types.CameraInfo, image_info, lambda m: self.sent.setdefault(stamp_ns(m), time.monotonic())),
            (types.Odometry, "/odom", self._on_pose),
            (types.Header, PROGRESS_TOPIC, self._on_progress),
        ):
            node.create_subscription(kind, topic, callback, sensor_qos(1000))

    def _on_pose(self, message: Any) -> None:
        self.received.setdefault(stamp_ns(message), time.monotonic())
        self.odometry.append(estimate_from_message(message))

    def _on_progress(self, header: Any) -> None:
        stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        self.progress[header.frame_id].setdefault(stamp, time.monotonic())

    def settle(self, begin_s: float) -> None:
        """Forget the frames before, in which compiled kernels are loaded."""
        self.sent = {stamp: t for stamp, t in self.sent.items() if t >= begin_s}

    def lags_ms(self, received: dict[int, float]) -> np.ndarray:
        """Of every frame that came and has a pose."""
        return 1e3 * np.array([received[s] - t for s, t in self.sent.items() if s in received and s in self.received])


def commands_of(graph: NodeGraph, composed: bool, folder: Path) -> list[NodeCommand]:
    """The nodes as a live user starts them: the newest frames count."""
    live = [
        NodeCommand(c.package, c.executable, tuple(a for a in _without_replay(c.arguments)), c.namespace)
        for c in graph.commands
    ]
    if not composed:
        return live
    path = folder / "nodes.json"
    path.write_text(json.dumps([(c.package, c.executable, c.arguments, c.namespace) for c in live]))
    return [NodeCommand("slam_bringup", "slam_composed", ("--nodes", str(path)))]


def _without_replay(arguments: tuple[str, ...]) -> list[str]:
    kept: list[str] = []
    for argument in arguments:
        if argument.startswith("input.policy"):
            kept.pop()  # its -p
        else:
            kept.append(argument)
    return kept


def cpu_s(nodes: list[NodeProcess]) -> dict[str, float]:
    """Processor seconds of each process so far."""
    used = {}
    for node in nodes:
        fields = Path(f"/proc/{node.process.pid}/stat").read_text().rpartition(")")[2].split()
        used[node.command.executable] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return used


def play(group: NodeGroup, supervisor: Supervisor, graph: NodeGraph, given: argparse.Namespace) -> Stopwatch:
    """Play the bag, and report."""
    nodes = list(group.nodes)
    watch = Stopwatch(supervisor, f"/{'tof' if given.mode == 'tof' else 'stereo/left'}/camera_info")
    player = group.start(_player(graph, given))
    supervisor.wait(lambda: bool(watch.sent), START_TIMEOUT_S, "the first frame")
    begin, before = time.monotonic() + given.settle, cpu_s(nodes)
    while player.is_running and time.monotonic() < begin + given.seconds:
        if time.monotonic() < begin:
            before, poses_before = cpu_s(nodes), len(watch.received)
        supervisor.listen(0.2)
    after, poses = cpu_s(nodes), len(watch.received) - poses_before
    player.interrupt()
    supervisor.listen(_AFTER_S)
    watch.settle(begin)
    report(watch, supervisor, given)
    each = {name: 1e3 * (after[name] - before[name]) / max(poses, 1) for name in after}
    print(f"  CPU {sum(each.values()):.0f} ms a pose: {', '.join(f'{n} {ms:.0f}' for n, ms in each.items())}")
    return watch


def _player(graph: NodeGraph, given: argparse.Namespace) -> NodeCommand:
    parameters = {
        "bag": str(given.bag),
        "rate": given.rate,
        "topics": tuple(graph.played),
        "rename": tuple(f"{t}={n}" for t, n in graph.played.items() if t != n),
        "nodes": tuple(command.full_name for command in graph.commands),
        "subscribers": tuple(f"{name}=1" for name in graph.played.values()),
    }
    return NodeCommand("slam_bags", "bag_player", tuple(ros_arguments(parameters)))


def report(watch: Stopwatch, supervisor: Supervisor, given: argparse.Namespace) -> None:
    """One line for the run, one for each node."""
    ms = watch.lags_ms(watch.received)
    kind = "one process" if given.composed else "separate nodes"
    if not len(ms):
        raise SystemExit(f"{kind}: no pose of {len(watch.sent)} frames")
    lost = len(watch.sent) - len(ms)
    print(f"{kind}, rate {given.rate:g}: {len(watch.sent)} frames, {lost} without a pose; stamp -> odom {_spread(ms)}")
    for node, values in sorted(supervisor.diagnostics.items()):
        counts = {k: values[k] for k in _COUNTERS if values.get(k, "0") != "0"}
        lag = _spread(watch.lags_ms(watch.progress[node]))
        print(f"  {node}: {values.get('latency_mean_ms', '-')} ms a frame, done after {lag} {counts or ''}")


def _spread(ms: np.ndarray) -> str:
    if not len(ms):
        return "-"
    return f"median {np.median(ms):.0f} ms, 95 % {np.percentile(ms, 95):.0f} ms, longest {ms.max():.0f} ms"


def accuracy(watch: Stopwatch, supervisor: Supervisor, graph: NodeGraph, given: argparse.Namespace) -> None:
    """ATE of ``odom`` and of the map that the nodes end with."""
    for name in (*graph.finishers, "/sjsam"):
        supervisor.call(f"{name}/finish")
    supervisor.wait_until_quiet(60.0)
    supervisor.call("/sjsam/finish")
    supervisor.call("/sjsam/save_map")
    with SensorBag(given.bag) as bag:
        truth = bag.ground_truth(bag.agents[0])
    if truth is None:
        return
    joined = GlobalMap.load(given.map_path).trajectory()
    for what, poses in (("odom", watch.odometry), *((f"map {agent}", poses) for agent, poses in joined.items())):
        found = evaluate(Trajectory.from_estimates(poses), truth, interpolate=True, max_difference_s=0.1)
        print(f"  {what}: {len(poses)} poses, ATE {1e3 * found.ate.rmse:.1f} mm, ANEES {found.anees or 0.0:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--mode", default="fuse")
    parser.add_argument("--odometry", default="ndt")
    parser.add_argument("--composed", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0, help="longest measurement")
    parser.add_argument("--settle", type=float, default=5.0, help="seconds at the start that do not count")
    parser.add_argument("--logs", type=Path, help="folder for the nodes' logs")
    given = parser.parse_args()
    config = choose(load_system_config(None), given.mode, "sjsam", given.odometry)
    with tempfile.TemporaryDirectory() as name, PrivateDomain() as domain:
        folder = Path(name)
        given.map_path = folder / "map"
        with SensorBag(given.bag) as bag:
            graph = plan_nodes(config, bag.sensors, given.odometry != "none", str(given.map_path))
        environment = node_environment(domain)
        with NodeGroup(environment, given.logs or folder) as group, Supervisor(environment, group.check) as supervisor:
            for command in commands_of(graph, given.composed, folder):
                group.start(command)
            watch = play(group, supervisor, graph, given)
            accuracy(watch, supervisor, graph, given)
            group.stop()


if __name__ == "__main__":
    main()
