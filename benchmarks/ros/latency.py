# SPDX-License-Identifier: Apache-2.0
"""How late are poses, and how many frames are left out, live? Separate nodes and one process, at a rate and beyond it.

    python benchmarks/ros/latency.py BAG [--rate 1.0] [--mode fuse] [--odometry ndt] [--composed] [--seconds 60]

Plays the bag without waiting for the nodes. The latency of a frame is the time from its camera info, which is sent with
its image, to its pose on ``odom``, both as this process receives them.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.node_graph import NodeGraph, plan_nodes
from slam_bringup.processes.online_run import START_TIMEOUT_S
from slam_bringup.processes.processes import NodeCommand, NodeGroup, PrivateDomain, node_environment
from slam_bringup.processes.supervisor_node import Supervisor
from slam_core.ros import RosTypes, sensor_qos

_COUNTERS = ("skipped", "missing", "lost_by_transport", "rejected")
_AFTER_S = 3.0
"""Poses may come for so long after the last image."""


class Stopwatch:
    """When the stamp of each image and of each pose was received, s."""

    def __init__(self, supervisor: Supervisor, image_info: str, odometry: str) -> None:
        self.sent: dict[int, float] = {}
        self.received: dict[int, float] = {}
        types, node = RosTypes(), supervisor._node
        for kind, topic, times in (
            (types.CameraInfo, image_info, self.sent),
            (types.Odometry, odometry, self.received),
        ):
            node.create_subscription(kind, topic, lambda m, t=times: self._note(m, t), sensor_qos(1000))

    @staticmethod
    def _note(message: object, times: dict[int, float]) -> None:
        stamp = message.header.stamp  # type: ignore[attr-defined]
        times.setdefault(stamp.sec * 1_000_000_000 + stamp.nanosec, time.monotonic())

    def settle(self, seconds: float) -> None:
        """Forget the frames of the first seconds, in which compiled kernels are loaded."""
        begin = min(self.sent.values(), default=0.0) + seconds
        self.sent = {stamp: t for stamp, t in self.sent.items() if t >= begin}

    def latencies_ms(self) -> np.ndarray:
        """Of every frame that has a pose."""
        return 1e3 * np.array([self.received[s] - t for s, t in self.sent.items() if s in self.received])


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--mode", default="fuse")
    parser.add_argument("--odometry", default="ndt")
    parser.add_argument("--composed", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0, help="longest measurement")
    parser.add_argument("--settle", type=float, default=5.0, help="seconds at the start that do not count")
    given = parser.parse_args()
    config = choose(load_system_config(None), given.mode, "sjsam", given.odometry)
    with tempfile.TemporaryDirectory() as name, PrivateDomain() as domain:
        folder = Path(name)
        with SensorBag(given.bag) as bag:
            graph = plan_nodes(config, bag.sensors, given.odometry != "none", str(folder / "map"))
        environment = node_environment(domain)
        with NodeGroup(environment, folder) as group, Supervisor(environment, group.check) as supervisor:
            for command in commands_of(graph, given.composed, folder):
                group.start(command)
            names = [c.full_name for c in graph.commands]
            supervisor.wait(lambda: all(n in supervisor.diagnostics for n in names), START_TIMEOUT_S, "start")
            watch = Stopwatch(supervisor, "/stereo/left/camera_info", "/odom")
            parameters = {
                "bag": str(given.bag),
                "rate": given.rate,
                "topics": tuple(graph.played),
                "rename": tuple(f"{t}={n}" for t, n in graph.played.items() if t != n),
            }
            player = group.start(NodeCommand("slam_bringup", "bag_player", tuple(ros_arguments(parameters))))
            end = time.monotonic() + given.seconds
            while player.is_running and time.monotonic() < end:
                supervisor.listen(0.2)
            player.interrupt()
            supervisor.listen(_AFTER_S)
            report(watch, supervisor, given)
            poses = len(watch.received)
            group.stop()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"  {1e3 * (used.ru_utime + used.ru_stime) / poses:.0f} ms of CPU a pose, all processes and their start")


def report(watch: Stopwatch, supervisor: Supervisor, given: argparse.Namespace) -> None:
    """One line for the run, one for each node that left frames out."""
    watch.settle(given.settle)
    ms = watch.latencies_ms()
    lost = len(watch.sent) - len(ms)
    kind = "one process" if given.composed else "separate nodes"
    if not len(ms):
        raise SystemExit(f"{kind}: no pose of {len(watch.sent)} frames")
    print(
        f"{kind}, rate {given.rate:g}: {len(watch.sent)} frames, {lost} without a pose; stamp -> odom "
        f"median {np.median(ms):.0f} ms, 95 % {np.percentile(ms, 95):.0f} ms, longest {ms.max():.0f} ms"
    )
    for node, values in sorted(supervisor.diagnostics.items()):
        counts = {
            k: values[k] for k in ("skipped", "missing", "lost_by_transport", "rejected") if values.get(k, "0") != "0"
        }
        print(f"  {node}: {values.get('latency_mean_ms', '-')} ms a frame {counts or ''}")


if __name__ == "__main__":
    main()
