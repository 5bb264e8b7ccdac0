# SPDX-License-Identifier: Apache-2.0
"""A filter on one host and the joiner on another, over a link that loses packets and breaks: the same map after.

    sudo python benchmarks/ros/two_hosts.py         needs ip, tc and unshare

The hosts are network namespaces with a virtual cable between them and a /dev/shm each, removed at
the end. Losses are netem's, on both
ends. "10 s cut": the cable is down for ten seconds in mid-run. Printed: submaps that the filter sent and that the map
has, and the largest difference of the map's poses from the run without losses.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), str(ROOT / "test" / "ekf_slam_node"), *map(str, (ROOT / "src").iterdir())]

HOSTS = ("slam_robot", "slam_base")
FRAMES, CUT_S = 60, 10.0
CASES = {"no loss": (0, False), "1 % loss": (1, False), "10 % loss": (10, False), "10 s cut": (0, True)}


def sh(command: str) -> None:
    """Run a command line; an error ends the benchmark."""
    subprocess.run(command, shell=True, check=True)


@contextmanager
def two_hosts(loss: int) -> Iterator[None]:
    """Two namespaces with a cable between them that loses ``loss`` percent each way."""
    robot, base = HOSTS
    try:
        for i, host in enumerate(HOSTS):
            sh(f"ip netns add {host}")
            sh(f"ip netns exec {host} ip link set lo up")
            if i == 0:
                sh(f"ip link add slamv0 netns {robot} type veth peer name slamv1")
        sh(f"ip link set slamv1 netns {base}")
        for i, host in enumerate(HOSTS):
            sh(f"ip netns exec {host} ip addr add 10.77.0.{i + 1}/24 dev slamv{i}")
            sh(f"ip netns exec {host} ip link set slamv{i} up")
            sh(f"ip netns exec {host} ip route add 224.0.0.0/4 dev slamv{i}")
            if loss:
                sh(f"ip netns exec {host} tc qdisc add dev slamv{i} root netem loss {loss}%")
        yield
    finally:
        for host in HOSTS:
            subprocess.run(f"ip netns del {host}", shell=True, check=False)


def on(host: str, *arguments: str) -> list[str]:
    """Command line of this Python on a host with a /dev/shm of its own."""
    script = 'mount -t tmpfs tmpfs /dev/shm; exec "$@"'
    return ["ip", "netns", "exec", host, "unshare", "-m", "sh", "-c", script, "sh", sys.executable, *arguments]


def run(name: str, folder: Path) -> tuple[int, np.ndarray, np.ndarray]:
    """Submaps sent, stamps and poses of the map's path."""
    loss, cut = CASES[name]
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    }  # fmt: skip
    with two_hosts(loss):
        node = "from sjsam_node.node import main; main()"
        parameters = ["--ros-args", "-p", f"map_path:={folder / 'map'}"]
        joiner = subprocess.Popen(on(HOSTS[1], "-c", node, *parameters), env=environment)
        try:
            robot = subprocess.Popen(on(HOSTS[0], __file__, "--robot", str(folder), str(int(cut))), env=environment)
            if cut:
                _cut(folder)
            if robot.wait(600):
                raise SystemExit(f"{name}: the robot's side failed")
        finally:
            joiner.kill()
            joiner.wait()
    found = np.load(folder / "path.npz")
    return int(found["sent"]), found["stamps"], found["poses"]


def _cut(folder: Path) -> None:
    """Take the cable away for a while, when the robot says so."""
    while not (folder / "middle").exists():
        time.sleep(0.1)
    for state in ("down", "up"):
        sh(f"ip netns exec {HOSTS[1]} ip link set slamv1 {state}")
        if state == "down":
            time.sleep(CUT_S)
    sh(f"ip netns exec {HOSTS[1]} ip route replace 224.0.0.0/4 dev slamv1")


def robot(folder: Path, cut: bool) -> None:
    """The robot's side: filter, features, and what it hears of the map."""
    import rclpy
    from feature_world import loop

    from feature_chain import START, STEP_NS, Chain, stamp_of
    from slam_core.messages import path_from_message

    domain = int(os.environ["ROS_DOMAIN_ID"])
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, folder, joiner=False)
    chain.listen("submap/info", chain.types.DiagnosticArray, latched=True)
    try:
        chain.wait(lambda: bool(chain.node.get_publishers_info_by_topic("map/path")), "no joiner", 120.0)
        chain.connect()
        poses = loop(FRAMES)
        chain.send_frames(poses[: FRAMES // 2], START)
        chain.wait_for_odometry(START + (FRAMES // 2 - 1) * STEP_NS)
        if cut:
            (folder / "middle").touch()
            time.sleep(2.0)
        chain.send_frames(poses[FRAMES // 2 :], START + FRAMES // 2 * STEP_NS)
        last = START + (FRAMES - 1) * STEP_NS
        chain.wait_for_odometry(last)
        assert chain.call("/ekf_slam/finish").success
        paths = chain.received["map/path"]
        end = time.monotonic() + 120.0
        while time.monotonic() < end and not any(stamp_of(p) == last for m in paths for p in m.poses):
            chain.executor.spin_once(timeout_sec=0.05)
        found = path_from_message(paths[-1])
        sent = len(chain.received["submap/info"])
        stamps, transforms = [s for s, _ in found], [T for _, T in found]
        np.savez(folder / "path.npz", sent=sent, stamps=stamps, poses=transforms)
    finally:
        chain.end()
        rclpy.shutdown(context=context)


def main() -> None:
    if sys.argv[1:2] == ["--robot"]:
        robot(Path(sys.argv[2]), sys.argv[3] == "1")
        return
    expected = None
    print(f"{'link':10} {'sent':>5} {'poses':>6} {'difference m':>13}")
    for name in CASES:
        with tempfile.TemporaryDirectory() as folder:
            sent, stamps, poses = run(name, Path(folder))
        expected = expected if expected is not None else (stamps, poses)
        same = np.array_equal(stamps, expected[0])
        difference = f"{np.abs(poses - expected[1]).max():13.2e}" if same else "  other stamps"
        print(f"{name:10} {sent:5} {len(stamps):6} {difference}", flush=True)


if __name__ == "__main__":
    main()
