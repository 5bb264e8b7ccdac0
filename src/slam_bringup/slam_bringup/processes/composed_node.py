# SPDX-License-Identifier: Apache-2.0
"""``slam_composed``: all nodes of a rig in one process, on a thread each, handing messages over by reference.

    ros2 run slam_bringup slam_composed --mode fuse --odometry ndt
    ros2 run slam_bringup slam_composed --agents one,two --ros-args -p use_sim_time:=true

Topics, parameters, services and namespaces are those of the separate nodes; ``--ros-args`` go to every one of them.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from slam_bringup.pipeline.configuration import ODOMETRIES, choose, load_system_config
from slam_bringup.pipeline.node_table import node_named
from slam_bringup.processes.node_graph import live_nodes
from slam_bringup.processes.processes import NodeCommand
from slam_core.nodes.exchange import Exchange
from slam_core.ros import spin, use_fast_dds_profile
from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.runtime.memory import search_less_garbage, share_one_heap
from slam_core.runtime.process_life import end_with_parent, on_request_to_end
from stereo_frontend.frontend_config import MODES

_JOIN_S = 10.0


def run_composed(commands: Sequence[NodeCommand], ros_arguments: Sequence[str] = ()) -> None:
    """Run nodes, given front to back, until SIGINT, SIGTERM or SIGHUP; each finishes what it is at.

    Raises
    ------
    ValueError
        If a node refuses its parameters.
    """
    share_one_heap()
    use_one_blas_thread()
    use_fast_dds_profile(small_packets=True)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    stopped = threading.Event()
    on_request_to_end(lambda *_: stopped.set())
    nodes: list[Any] = []
    try:
        end_with_parent()
        exchange = Exchange()
        for command in commands:
            nodes.append(_make(exchange, command, ros_arguments))
        search_less_garbage()
        threads = [threading.Thread(target=_spin, args=(node, stopped), name=node.get_name()) for node in nodes]
        for thread in threads:
            thread.start()
        for node in nodes:
            node.get_logger().info("ready")
        stopped.wait()
        for thread in threads:
            thread.join(_JOIN_S)
    finally:
        for node in nodes:
            node.on_close()
            node.destroy_node()
        rclpy.try_shutdown()


def _make(exchange: Exchange, command: NodeCommand, ros_arguments: Sequence[str]) -> Any:
    node_type = node_named(command.executable).load_node_class()
    with exchange.node([*command.arguments, *ros_arguments]):
        return node_type()


def _spin(node: Any, stopped: threading.Event) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        spin(node, executor, stopped)
    finally:
        stopped.set()  # a thread that ends for whatever reason ends the process, which its user can start again
        executor.shutdown(timeout_sec=2.0)


def _arguments(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("slam_composed", description="All nodes of a rig in one process.")
    parser.add_argument("--mode", choices=MODES, default="stereo", help="where depth comes from")
    parser.add_argument("--odometry", choices=ODOMETRIES, default="none", help="scan odometry from the ToF camera")
    parser.add_argument("--agents", default="", help="names of the agents, comma-separated; none: one rig")
    parser.add_argument("--config", type=Path, help="YAML of overrides, one group per node")
    parser.add_argument("--nodes", type=Path, help="file of the nodes to run, as slam nodes --composed writes it")
    return parser.parse_args(arguments)


def commands_of(arguments: argparse.Namespace) -> list[NodeCommand]:
    """The nodes that command-line arguments ask for."""
    if arguments.nodes:
        return [NodeCommand(*entry) for entry in json.loads(arguments.nodes.read_text(encoding="utf-8"))]
    config = choose(load_system_config(arguments.config), arguments.mode, "sjsam", arguments.odometry)
    agents = [name.strip() for name in arguments.agents.split(",")]
    return [spec.command for spec in live_nodes(config, agents, odometry=arguments.odometry != "none")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the executable: a bad parameter ends it with one line and exit code 2."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    split = given.index("--ros-args") if "--ros-args" in given else len(given)
    try:
        run_composed(commands_of(_arguments(given[:split])), given[split:])
    except (ValueError, OSError) as error:
        print(f"cannot start: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
