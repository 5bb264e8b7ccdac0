# SPDX-License-Identifier: Apache-2.0
"""Growth of memory and latency over an hour of bag time through filter and joiner, moving and standing.

    python benchmarks/ros/soak.py [MINUTES] [--only moving|standing]      60 by default, of bag time for each of the two

Frames at 10 Hz of bag time are sent as fast as the nodes take them (feature level, parameters as by default). Memory is
the private memory of each node. The slopes are least-squares lines through the second half of the run. The map of a rig
that moves for an hour is large: the joiner's growth is therefore also given for each of its submaps. Latencies are the
times from a frame's sending to its odometry, and from a submap's arrival here to the joiner's word that it has it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), *map(str, (ROOT / "src").iterdir())]

import rclpy  # noqa: E402

from feature_chain import START, STEP_NS, Chain, stamp_of  # noqa: E402
from feature_world import loop  # noqa: E402
from slam_core.nodes.base_node import PROGRESS_TOPIC  # noqa: E402
from slam_core.ros import sensor_qos  # noqa: E402

LAP, RATE = 200, 10.0
MAY_WAIT = 3
"""Submaps that may wait to be joined before the next frame is sent."""


class Soak:
    """One run: frames in, and when the answer to each came."""

    def __init__(self, chain: Chain, moving: bool) -> None:
        self.chain = chain
        self.poses = loop(LAP) if moving else [loop(LAP)[0]] * LAP
        self.latency_ms: list[float] = []
        self.joining_ms: list[float] = []
        self.samples: list[tuple[float, ...]] = []
        """Minute of bag time, submaps, MiB of each node."""
        self._heard: dict[int, float] = {}
        chain.node.create_subscription(
            chain.types.DiagnosticArray, "submap/info", self._on_submap, sensor_qos(1000, True)
        )
        chain.node.create_subscription(chain.types.Header, PROGRESS_TOPIC, self._on_progress, sensor_qos(1000))

    def run(self, minutes: float) -> None:
        """Send everything; a sample each minute."""
        for k in range(round(60.0 * RATE * minutes) + 1):
            if k % round(60.0 * RATE) == 0:
                self._sample(k / RATE / 60.0)
            self._frame(self.poses[k % LAP], START + k * STEP_NS)

    def _frame(self, T: np.ndarray, stamp: int) -> None:
        sent = time.perf_counter()
        self.chain.send_frame(T, stamp)
        odometry = self.chain.received["odom"]
        self.chain.wait(lambda: bool(odometry) and stamp_of(odometry[-1]) >= stamp, "no odometry")
        self.latency_ms.append(1e3 * (time.perf_counter() - sent))
        self.chain.wait(lambda: len(self._heard) <= MAY_WAIT, "submaps are not joined")

    def _sample(self, minute: float) -> None:
        memory = (private_mib(process.pid) for process in self.chain.processes.values())
        self.samples.append((minute, len(self.joining_ms), *memory))
        for messages in self.chain.received.values():
            del messages[:-2]
        if minute and minute % 10 == 0:
            print(f"  {minute:.0f} min: {self.samples[-1]}", file=sys.stderr, flush=True)

    def _on_submap(self, message: object) -> None:
        self._heard[stamp_of(message)] = time.perf_counter()

    def _on_progress(self, header: object) -> None:
        stamp = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)  # type: ignore[attr-defined]
        if header.frame_id == "/sjsam" and stamp in self._heard:  # type: ignore[attr-defined]
            self.joining_ms.append(1e3 * (time.perf_counter() - self._heard.pop(stamp)))


def soak(moving: bool, minutes: float, domain: int, folder: Path) -> None:
    """One run and its lines of the table."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, folder, small_submaps=False)
    try:
        run = Soak(chain, moving)
        chain.connect()
        run.run(minutes)
        report("moving" if moving else "standing", run, list(chain.processes))
    finally:
        codes = chain.end()
        rclpy.shutdown(context=context)
    assert not any(codes), codes


def report(what: str, run: Soak, names: list[str]) -> None:
    """The lines of one run."""
    table = np.array(run.samples)
    half = table[len(table) // 2 :]
    for i, name in enumerate(names, start=2):
        growth = f"{table[0, i]:6.0f} -> {table[len(table) // 2, i]:6.0f} -> {table[-1, i]:6.0f} MiB"
        each = f", {1024 * slope(half[:, 1], half[:, i]):+.0f} KiB a submap" if name == "sjsam" else ""
        print(f"{what:9} {name:9} {growth}, {60.0 * slope(half[:, 0], half[:, i]):+7.1f} MiB/h{each}")
    for name, ms in (("frame", run.latency_ms), ("submap", run.joining_ms)):
        late = np.array(ms[len(ms) // 2 :])
        hours = np.linspace(0.0, 0.5 * table[-1, 0] / 60.0, len(late))
        print(
            f"{what:9} {len(ms):6} times a {name:6} median {np.median(ms):6.1f} ms, 99 % {np.percentile(ms, 99):7.1f} "
            f"ms, {slope(hours, late):+8.2f} ms/h",
            flush=True,
        )


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """Of the least-squares line; NaN where there is none."""
    return float(np.polyfit(x, y, 1)[0]) if len(x) > 1 and np.ptp(x) > 0 else float("nan")


def private_mib(pid: int) -> float:
    """Memory that a process shares with nobody."""
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(fields["RssAnon"].split()[0]) / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("minutes", type=float, nargs="?", default=60.0)
    parser.add_argument("--only", choices=("moving", "standing"))
    given = parser.parse_args()
    for moving in (True, False):
        if given.only in (None, "moving" if moving else "standing"):
            with tempfile.TemporaryDirectory() as folder:
                soak(moving, given.minutes, 1 + (os.getpid() + moving) % 100, Path(folder))


if __name__ == "__main__":
    main()
