# SPDX-License-Identifier: Apache-2.0
"""Each node of a rig killed with -9 in the middle of the demo, and started again: what is lost, and for how long.

    python benchmarks/ros/killed.py [NODE ...]

The nodes run as processes, dense model and page among them, and at last as one process; the bag is played at a quarter
of its speed and waits for nobody. others: all other nodes still run. ready: seconds from the kill until the node, which
is started at once, has all its inputs connected. lost: frames without odometry. gap: the longest run of them. sessions
and submaps: in the map that is saved at the end.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "bags" / "demo"
sys.path[:0] = [str(ROOT / "test"), *map(str, (ROOT / "src").iterdir())]

import rclpy  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from slam_bags.nodes.pacing import Connections  # noqa: E402
from slam_bags.reading.sensor_bag import SensorBag  # noqa: E402
from slam_bringup.pipeline.configuration import choose, system_config  # noqa: E402
from slam_bringup.pipeline.overrides import overrides_of, parse_assignments  # noqa: E402
from slam_bringup.processes.node_arguments import ros_arguments  # noqa: E402
from slam_bringup.processes.node_graph import NodeGraph, plan_nodes, viewer_nodes  # noqa: E402
from slam_bringup.processes.processes import NodeCommand, NodeGroup, PrivateDomain, node_environment  # noqa: E402
from slam_core.messages import stamp_ns  # noqa: E402

NODES = ("none", "stereo_driver", "tof_driver", "feature_extractor", "ndt_odometry", "ekf_slam", "sjsam",
         "dense_mapper", "viewer", "slam_composed")  # fmt: skip
SETTINGS = "ekf_slam.submap.max_distance=0.4, sjsam.autosave_period_s=0.5"
RATE, STRUCK, STEP_NS = 0.25, 20, 100_000_000
QUIET_S, PATIENCE_S = 4.0, 300.0


class Rig:
    """All nodes of the demo in a domain of their own, and who listens to them."""

    def __init__(self, domain: int, group: NodeGroup, folder: Path, composed: bool) -> None:
        overrides = overrides_of(parse_assignments(SETTINGS), "killed.py")
        config = choose(system_config(overrides), "fuse", "sjsam", "ndt")
        self.map_path, self.group, self.connections = folder / "map", group, Connections()
        with SensorBag(DEMO) as bag:
            graph = plan_nodes(config, bag.sensors, True, str(self.map_path), overrides, autosave=True)
            shown = [spec.command for spec in viewer_nodes(config, bag.sensors, 8300 + domain)]
            self.frames = bag.count("", "left")
        self.names = [command.full_name for command in graph.commands]
        commands = [composed_of(graph, folder)] if composed else [*graph.commands, *shown]
        self.commands = {command.executable: command for command in commands}
        self.processes = {name: group.start(command) for name, command in self.commands.items()}
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.probe = Probe(self.context)
        self.probe.listen("odom", Odometry)
        self.probe.listen("/diagnostics", self.probe.types.DiagnosticArray)
        self.player = group.start(player(graph, self.names))

    @property
    def stamps(self) -> list[int]:
        """Stamps of the frames with odometry."""
        return [stamp_ns(message) for message in self.probe.received["odom"]]

    def kill(self, name: str) -> float:
        """Kill a node, start it again; seconds until it is connected."""
        self.processes[name].process.kill()
        self.processes[name].process.wait()
        began = time.monotonic()
        self.processes[name] = self.group.start(self.commands[name])
        names = self.names if name == "slam_composed" else [self.commands[name].full_name]
        self.connections = Connections()
        self.probe.received["/diagnostics"].clear()
        self.probe.wait(lambda: self.are_connected(names), f"{name} does not come back", PATIENCE_S)
        return time.monotonic() - began

    def are_connected(self, names: list[str]) -> bool:
        """True if the nodes have said so."""
        for message in self.probe.received["/diagnostics"]:
            for status in message.status:
                self.connections.report(status.name, {entry.key: entry.value for entry in status.values})
        return not self.connections.obstacles(names)

    def saved_map(self) -> GlobalMap:
        """The map once nothing comes any more."""
        count, since = -1, time.monotonic()
        while time.monotonic() - since < QUIET_S:
            self.probe.executor.spin_once(timeout_sec=0.1)
            if len(self.stamps) != count:
                count, since = len(self.stamps), time.monotonic()
        for service in ("/ekf_slam/finish", "/sjsam/finish", "/sjsam/save_map"):
            client = self.probe.node.create_client(Trigger, service)
            self.probe.wait(client.service_is_ready, f"no {service}")
            future = client.call_async(Trigger.Request())
            self.probe.wait(future.done, f"{service} does not answer", PATIENCE_S)
            assert future.result().success, future.result().message
        return GlobalMap.load(self.map_path)

    def end(self) -> None:
        """Stop listening."""
        self.probe.executor.shutdown(timeout_sec=2.0)
        self.probe.node.destroy_node()
        rclpy.shutdown(context=self.context)


def composed_of(graph: NodeGraph, folder: Path) -> NodeCommand:
    """All nodes as one process."""
    path = folder / "nodes.json"
    path.write_text(json.dumps([(c.package, c.executable, c.arguments, c.namespace) for c in graph.commands]))
    return NodeCommand("slam_bringup", "slam_composed", ("--nodes", str(path)))


def player(graph: NodeGraph, names: list[str]) -> NodeCommand:
    """The bag, once all nodes are connected."""
    parameters = {
        "bag": str(DEMO),
        "rate": RATE,
        "topics": tuple(graph.played),
        "nodes": tuple(names),
        "rename": tuple(f"{topic}={name}" for topic, name in graph.played.items() if name != topic),
        "subscribers": tuple(f"{name}=1" for name in graph.played.values()),
        "wait_for_subscribers": 0.0,
    }
    return NodeCommand("slam_bags", "bag_player", tuple(ros_arguments(parameters)))


def run(name: str, folder: Path) -> str:
    """One line of the table."""
    with PrivateDomain() as domain, NodeGroup(node_environment(domain), folder / "logs") as group:
        rig = Rig(domain, group, folder, name == "slam_composed")
        try:
            rig.probe.wait(lambda: len(rig.stamps) >= STRUCK, "no odometry", PATIENCE_S)
            ready = 0.0 if name == "none" else rig.kill(name)
            rig.probe.wait(lambda: not rig.player.is_running, "the player does not end", PATIENCE_S)
            keys = rig.saved_map().snapshot().keys
            stamps = sorted(set(rig.stamps))
            gap = max((b - a) / STEP_NS - 1 for a, b in itertools.pairwise(stamps))
            alive = all(process.is_running for process in rig.processes.values())
            lost = rig.frames - len(stamps)
            sessions = len({key[1] for key in keys})
            return f"{name:20} {'yes' if alive else 'NO':6} {ready:6.1f} {lost:5} {gap:5.0f} {sessions:8} {len(keys):8}"
        finally:
            rig.end()


def main() -> None:
    print(f"{'killed':20} {'others':6} {'ready':>6} {'lost':>5} {'gap':>5} {'sessions':>8} {'submaps':>8}")
    for name in sys.argv[1:] or NODES:
        with tempfile.TemporaryDirectory() as folder:
            try:
                print(run(name, Path(folder)), flush=True)
            except (AssertionError, ValueError) as error:
                print(f"{name:20} NO     {error}", flush=True)


if __name__ == "__main__":
    main()
