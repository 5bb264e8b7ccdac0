# SPDX-License-Identifier: Apache-2.0
"""Longest time for which ``sjsam`` answers nothing while it loads, joins and saves a large map.

    python benchmarks/ros/silence.py [--submaps 2000] [--laps 1.2]

The map is joined here and loaded by the node, which then settles and saves it: one batch of all submaps. Meanwhile its
odometry goes on at 10 Hz and it is asked to mark a place, again and again. Wall time: other work beside it counts.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), str(ROOT / "benchmarks" / "joining")]

import rclpy  # noqa: E402
from problems import ring  # noqa: E402 - sets the import path
from std_srvs.srv import Trigger  # noqa: E402

from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from sjsam_node.map_file import storage  # noqa: E402
from slam_core.messages import odometry_message  # noqa: E402
from slam_core.types import PoseEstimate  # noqa: E402

_DOMAIN = 57
_STEP_S = 0.1


@dataclass
class Listener:
    """Arrival times of transforms and poses, and how long each answer took, s."""

    probe: Probe
    stamp_ns: int
    arrivals: dict[str, list[float]] = field(default_factory=lambda: {"map_to_odom": [], "pose": []})
    answers: list[float] = field(default_factory=list)
    _asked: tuple[float, Any] | None = None

    def __post_init__(self) -> None:
        kinds = {"map_to_odom": "TransformStamped", "pose": "PoseWithCovarianceStamped"}
        for topic, kind in kinds.items():
            self.probe.node.create_subscription(
                getattr(self.probe.types, kind),
                topic,
                lambda _, t=topic: self.arrivals[t].append(time.monotonic()),
                100,
            )
        self._marks = self.probe.node.create_client(Trigger, "/sjsam/mark_here")

    def step(self) -> None:
        """Send odometry, ask if the last question was answered, and listen for a while."""
        self.stamp_ns += round(1e9 * _STEP_S)
        pose = PoseEstimate(self.stamp_ns, np.eye(4), 1e-6 * np.eye(6))
        self.probe.send("odom", odometry_message(self.probe.types, "odom", "base_link", pose))
        if self._asked is None:
            self._asked = time.monotonic(), self._marks.call_async(Trigger.Request())
        end = time.monotonic() + _STEP_S
        while (left := end - time.monotonic()) > 0:
            self.probe.executor.spin_once(timeout_sec=left)
            if self._asked is not None and self._asked[1].done():
                self.answers.append(time.monotonic() - self._asked[0])
                self._asked = None

    def call(self, name: str) -> float:
        """Call a service and go on until it answers; the time that took, s."""
        began = time.monotonic()
        future = self.probe.node.create_client(Trigger, f"/sjsam/{name}").call_async(Trigger.Request())
        while not future.done():
            self.step()
        assert future.result().success, future.result().message
        return time.monotonic() - began


def build(count: int, laps: float, folder: Path) -> int:
    """Join submaps of a ring and write the map as it is, unsettled; the stamp of its end."""
    joined = GlobalMap()
    submaps = ring(count, laps, density=12.0).submaps
    for submap in submaps:
        joined.add(submap)
    storage.write(folder, joined.stored())
    return submaps[-1].end_stamp_ns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--submaps", type=int, default=2000)
    parser.add_argument("--laps", type=float, default=1.2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        stamp_ns = build(arguments.submaps, arguments.laps, Path(folder) / "map")
        command = "import sys; from sjsam_node.node import main; main()"
        node = subprocess.Popen(
            [
                sys.executable,
                "-c",
                command,
                "--ros-args",
                "-p",
                f"map_path:={folder}/map",
                "-p",
                f"ply_path:={folder}/map.ply",
            ],
            env={**os.environ, "ROS_DOMAIN_ID": str(_DOMAIN), "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        try:
            context = rclpy.Context()
            rclpy.init(context=context, domain_id=_DOMAIN)
            print_row(arguments.submaps, Listener(Probe(context), stamp_ns))
        finally:
            node.terminate()
            node.wait()


def print_row(submaps: int, listener: Listener) -> None:
    client = listener.probe.node.create_client(Trigger, "/sjsam/load_map")
    listener.probe.wait(client.service_is_ready, "the node does not start", 120.0)
    took = {name: listener.call(name) for name in ("load_map", "save_map", "export_ply")}
    gaps = {topic: np.diff(times).max() for topic, times in listener.arrivals.items()}
    print(f"{submaps} submaps: " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in took.items()))
    print(
        f"longest time without map_to_odom {gaps['map_to_odom']:.2f} s, without pose {gaps['pose']:.2f} s, "
        f"longest wait for an answer {max(listener.answers):.2f} s of {len(listener.answers)}"
    )


if __name__ == "__main__":
    main()
