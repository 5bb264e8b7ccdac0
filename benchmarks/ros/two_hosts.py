# SPDX-License-Identifier: Apache-2.0
"""A filter on one host and the joiner on another, over a link that loses packets and breaks: the same map after.

    sudo python benchmarks/ros/two_hosts.py [LINK ...]          needs ip, unshare and /dev/net/tun

The hosts are network namespaces with a cable between them (lossy_link.py) and a /dev/shm each, removed at the end.
"10 s cut": the cable carries nothing for ten seconds in mid-run. Printed: submaps that the filter sent, poses in the
map, the largest difference of the map's poses from the run without losses, how long after the last frame the map was
complete, and what went over the cable.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), *map(str, (ROOT / "src").iterdir())]

from lossy_link import two_hosts  # noqa: E402

HOSTS = ("slam_robot", "slam_base")
FRAMES, PATIENCE_S = 60, 180.0
LINKS = {"no loss": (0.0, 0.0), "1 % loss": (0.01, 0.0), "10 % loss": (0.1, 0.0), "10 s cut": (0.0, 10.0),
         "30 s cut": (0.0, 30.0)}  # fmt: skip
"""Share of the packets that are lost, and how long none arrives, s; after 20 s the other side is taken for dead."""


@dataclass(frozen=True)
class Outcome:
    """What the robot heard of the map. late_s: from the filter's last word to the last pose of the map."""

    sent: int
    stamps: np.ndarray
    poses: np.ndarray
    late_s: float
    mebibytes: float


def on(host: str, *arguments: str) -> list[str]:
    """Command line of this Python on a host with a /dev/shm of its own."""
    script = 'mount -t tmpfs tmpfs /dev/shm; exec "$@"'
    return ["ip", "netns", "exec", host, "unshare", "-m", "sh", "-c", script, "sh", sys.executable, *arguments]


def run(name: str, folder: Path) -> Outcome:
    """One drive over one link."""
    loss, cut_s = LINKS[name]
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    }
    with two_hosts(HOSTS, loss) as link:
        node = "from sjsam_node.node import main; main()"
        parameters = ["--ros-args", "-p", f"map_path:={folder / 'map'}"]
        joiner = subprocess.Popen(on(HOSTS[1], "-c", node, *parameters), env=environment)
        try:
            robot = subprocess.Popen(on(HOSTS[0], __file__, "--robot", str(folder), str(int(cut_s))), env=environment)
            while cut_s and robot.poll() is None and not (folder / "middle").exists():
                time.sleep(0.1)
            link.loss = 1.0 if cut_s else loss
            time.sleep(cut_s)
            link.loss = loss
            if robot.wait(600):
                raise SystemExit(f"{name}: the robot's side failed")
        finally:
            joiner.kill()
            joiner.wait()
        found = np.load(folder / "path.npz")
        return Outcome(
            int(found["sent"]), found["stamps"], found["poses"], float(found["late_s"]), link.carried_bytes / 2**20
        )


def robot(folder: Path, cut: bool) -> None:
    """The robot's side: filter, features, and what it hears of the map."""
    import rclpy

    from feature_chain import START, STEP_NS, Chain, stamp_of
    from feature_world import loop
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
        paths, started = chain.received["map/path"], time.monotonic()
        while time.monotonic() < started + PATIENCE_S and not any(stamp_of(p) == last for m in paths for p in m.poses):
            chain.executor.spin_once(timeout_sec=0.05)
        late_s = time.monotonic() - started
        found = path_from_message(paths[-1])
        sent = len(chain.received["submap/info"])
        stamps, transforms = [s for s, _ in found], [T for _, T in found]
        np.savez(folder / "path.npz", sent=sent, stamps=stamps, poses=transforms, late_s=late_s)
    finally:
        chain.end()
        rclpy.shutdown(context=context)


def main() -> None:
    if sys.argv[1:2] == ["--robot"]:
        robot(Path(sys.argv[2]), sys.argv[3] == "1")
        return
    first = None
    print(f"{'link':10} {'sent':>5} {'poses':>6} {'difference m':>13} {'complete after s':>17} {'MiB':>6}")
    for name in sys.argv[1:] or LINKS:
        with tempfile.TemporaryDirectory() as folder:
            found = run(name, Path(folder))
        first = first or found
        same = np.array_equal(found.stamps, first.stamps)
        difference = f"{np.abs(found.poses - first.poses).max():13.2e}" if same else "  other stamps"
        figures = f"{found.late_s:17.1f} {found.mebibytes:6.1f}"
        print(f"{name:10} {found.sent:5} {len(found.stamps):6} {difference} {figures}", flush=True)


if __name__ == "__main__":
    main()
