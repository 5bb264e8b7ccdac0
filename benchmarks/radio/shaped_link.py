# SPDX-License-Identifier: Apache-2.0
"""Two radio_link nodes in network namespaces with a shaped link between them; all bytes on the wire are counted.

    sudo python benchmarks/radio/shaped_link.py RUN [--rate 500kbit] [--silence 30 60] [--seconds 120]

RUN: the folder of a run with its ``map``. The submaps of its first agent are published as they ended, in real time,
with odometry at 10 Hz; the post keeps what arrives. It prints the submaps that arrived of those published, kB on the
wire (Ethernet frames, both directions, with TCP, Zenoh, acknowledgements and poses) in all and a metre of way, seconds
from a submap's end to its arrival, and from the end of the silence until all of before had arrived. Needs the workspace
to be sourced, and ip and tc; the silence is a rate of 80 bits a second.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from sjsam_node.map_file import storage
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import find_executable, node_environment
from slam_core.types import Submap

_AGENT, _POST = "slam_radio_agent", "slam_radio_post"
_ADDRESS = {_AGENT: "10.199.0.1", _POST: "10.199.0.2"}
_SILENT = "80bit"
_AFTER_S = 60.0
"""The link may work on for so long after the last submap."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--rate", default="500kbit", help="of the link, as tc writes it")
    parser.add_argument("--bytes-per-second", type=float, default=20000.0, help="budget of the agent")
    parser.add_argument("--silence", type=float, nargs=2, default=None, help="begin and end of a silence, s")
    parser.add_argument("--seconds", type=float, default=120.0, help="of the run that are played")
    parser.add_argument("--publish", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    submaps = first_agent(arguments.run, arguments.seconds)
    if arguments.publish:
        publish(submaps, arguments.publish)
    else:
        measure(submaps, arguments)


def first_agent(run: Path, seconds: float) -> list[Submap]:
    """Submaps of a run's first agent that ended in the first seconds."""
    submaps = [r.submap for r in storage.read(run / "map").state.graph.records]
    own = [s for s in submaps if s.agent == submaps[0].agent]
    return [s for s in own if s.end_stamp_ns - own[0].start_stamp_ns <= 1e9 * seconds]


def measure(submaps: list[Submap], arguments: argparse.Namespace) -> None:
    """Play the submaps over the link and print what became of them."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        stack.enter_context(namespaces(arguments.rate))
        endpoint = f"tcp/{_ADDRESS[_POST]}:7447"
        common = {"agents": ("anna",), "state_path": str(folder / "state")}
        post = common | {"role": "post", "listen": (endpoint,)}
        agent = common | {"connect": (endpoint,), "bytes_per_second": arguments.bytes_per_second}
        link = find_executable("slam_radio", "radio_link")
        logs = [folder / "post.log", folder / "agent.log"]
        stack.enter_context(process(_POST, [*link, *ros_arguments(post)], logs[0]))
        stack.enter_context(process(_AGENT, [*link, *ros_arguments(agent)], logs[1]))
        wait_for(lambda: all("ready" in log.read_text() for log in logs), 60.0)
        time.sleep(5.0)
        before, published = on_the_wire(), folder / "published.json"
        words = [sys.executable, __file__, str(arguments.run), "--seconds", str(arguments.seconds)]
        stack.enter_context(process(_AGENT, [*words, "--publish", str(published)], folder / "publisher.log"))
        wait_for(published.exists, 60.0)
        begun = float(published.read_text())
        inbox = folder / "state" / "inbox" / "anna"
        ends = {f"{s.session}-{s.index}.submap": begun + since(submaps, s.end_stamp_ns) for s in submaps}
        deadline = max(ends.values()) + _AFTER_S
        if arguments.silence:
            sleep_until(begun + arguments.silence[0])
            shape(_SILENT)
            sleep_until(begun + arguments.silence[1])
            shape(arguments.rate)
        sleep_until(max(ends.values()))
        while time.time() < deadline and len(list(inbox.glob("*.submap"))) < len(ends):
            time.sleep(0.2)
        used = on_the_wire() - before
        took = {f.name: f.stat().st_mtime - ends[f.name] for f in inbox.glob("*.submap")}
        silent = [f for f in took if arguments.silence and ends[f] < begun + arguments.silence[1]]
        gone = max((ends[f] + took[f] for f in silent), default=0.0) - begun - (arguments.silence or [0.0, 0.0])[1]
    way = sum(float(np.linalg.norm(s.end_pose[:3, 3])) for s in submaps)
    waits = np.array(list(took.values()))
    shares = np.percentile(waits, (50, 95, 100)) if len(waits) else np.full(3, np.nan)
    print(f"submaps {len(took)} of {len(ends)}, {used / 1e3:.0f} kB on the wire, {used / way / 1e3:.1f} kB/m, "
          f"arrival median {shares[0]:.1f} s, 95 % {shares[1]:.1f} s, most {shares[2]:.1f} s"
          + (f", backlog gone {gone:.1f} s after the silence" if silent else ""))  # fmt: skip


def since(submaps: list[Submap], stamp_ns: int) -> float:
    """Seconds from the start of the first submap."""
    return (stamp_ns - submaps[0].start_stamp_ns) * 1e-9


def publish(submaps: list[Submap], published: Path) -> None:
    """Publish submaps as they end and odometry at 10 Hz; the time of the start goes to a file."""
    import rclpy

    from slam_core.messages import SUBMAP_TOPICS, odometry_message, submap_messages
    from slam_core.ros import RosTypes, sensor_qos
    from slam_core.types import PoseEstimate

    rclpy.init()
    node, types = rclpy.create_node("recorded_filter"), RosTypes()
    senders = [node.create_publisher(getattr(types, k), t, sensor_qos(100, True)) for t, k in SUBMAP_TOPICS.items()]
    odometry = node.create_publisher(types.Odometry, "odom", sensor_qos(10))
    wait_for(lambda: senders[-1].get_subscription_count() and odometry.get_subscription_count(), 60.0)
    begun = time.time()
    published.write_text(repr(begun))
    T = np.eye(4)
    for submap in submaps:
        while time.time() < begun + since(submaps, submap.end_stamp_ns):
            stamp = submaps[0].start_stamp_ns + round(1e9 * (time.time() - begun))
            odometry.publish(odometry_message(types, "odom", "base_link", PoseEstimate(stamp, T, 1e-4 * np.eye(6))))
            time.sleep(0.1)
        T = T @ submap.end_pose
        for sender, message in zip(senders, submap_messages(types, submap), strict=True):
            sender.publish(message)
    signal.pause()


def wait_for(condition, seconds: float) -> None:  # type: ignore[no-untyped-def]
    end = time.time() + seconds
    while not condition():
        if time.time() > end:
            raise SystemExit("the nodes do not start: is the workspace sourced?")
        time.sleep(0.1)


def sleep_until(when: float) -> None:
    time.sleep(max(0.0, when - time.time()))


@contextmanager
def process(namespace: str, command: list[str], log: Path) -> Iterator[None]:
    """A process in a network namespace, ended by SIGINT."""
    environment = node_environment(42)
    with log.open("wb") as output:
        started = subprocess.Popen(
            ["ip", "netns", "exec", namespace, *command], env=environment, stdout=output, stderr=subprocess.STDOUT
        )
    try:
        yield
    finally:
        started.send_signal(signal.SIGINT)
        try:
            started.wait(15)
        except subprocess.TimeoutExpired:
            started.kill()
            started.wait()


@contextmanager
def namespaces(rate: str) -> Iterator[None]:
    """Two network namespaces, joined by a pair of interfaces."""
    try:
        for name in (_AGENT, _POST):
            run("ip", "netns", "add", name)
        run("ip", "link", "add", "radio0", "netns", _AGENT, "type", "veth", "peer", "name", "radio0", "netns", _POST)
        for name, address in _ADDRESS.items():
            run("ip", "-n", name, "addr", "add", f"{address}/24", "dev", "radio0")
            for device in ("lo", "radio0"):
                run("ip", "-n", name, "link", "set", device, "up")
        shape(rate)
        yield
    finally:
        for name in (_AGENT, _POST):
            subprocess.run(["ip", "netns", "del", name], check=False)


def shape(rate: str) -> None:
    """Rate of both directions; half a second of it is queued, the rest dropped."""
    for name in (_AGENT, _POST):
        bucket = ["tbf", "rate", rate, "burst", "3000", "latency", "500ms"]
        run("tc", "-n", name, "qdisc", "replace", "dev", "radio0", "root", *bucket)


def on_the_wire() -> int:
    """Bytes of Ethernet frames that both ends have sent so far."""
    total = 0
    for name in (_AGENT, _POST):
        shown = subprocess.run(
            ["ip", "-n", name, "-s", "-j", "link", "show", "radio0"], check=True, capture_output=True, text=True
        ).stdout
        total += int(json.loads(shown)[0]["stats64"]["tx"]["bytes"])
    return total


def run(*command: str) -> None:
    subprocess.run(command, check=True)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    main()
