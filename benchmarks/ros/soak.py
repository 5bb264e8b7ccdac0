# SPDX-License-Identifier: Apache-2.0
"""Growth of memory and latency over an hour of bag time through filter and joiner, moving and standing.

    python benchmarks/ros/soak.py [MINUTES]         60 by default, of bag time for each of the two

Frames at 10 Hz of bag time are sent as fast as the filter takes them (feature level). Memory is the resident set of
each node; the slopes are least-squares lines through the second half of the run, when all caches are warm. Latency is
the time from a frame's sending to its odometry.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), str(ROOT / "test" / "ekf_slam_node"), *map(str, (ROOT / "src").iterdir())]

import rclpy  # noqa: E402
from feature_world import loop  # noqa: E402

from feature_chain import START, STEP_NS, Chain, stamp_of  # noqa: E402

LAP = 200
SAMPLES_EVERY = 50


def soak(moving: bool, minutes: float, domain: int, folder: Path) -> None:
    """One run and its lines of the table."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, folder)
    try:
        chain.connect()
        poses, frames = loop(LAP), round(minutes * 600)
        latency, memory = [], []
        for k in range(frames):
            stamp, sent = START + k * STEP_NS, time.perf_counter()
            chain.send_frame(poses[k % LAP] if moving else poses[0], stamp)
            odometry = chain.received["odom"]
            chain.wait(lambda s=stamp, o=odometry: bool(o) and stamp_of(o[-1]) >= s, "no odometry", 120.0)
            latency.append(1e3 * (time.perf_counter() - sent))
            if k % SAMPLES_EVERY == 0:
                memory.append([k, *(_rss_mib(p.pid) for p in chain.processes.values())])
                for messages in chain.received.values():
                    del messages[:-2]
        _print(moving, minutes, list(chain.processes), np.array(memory), np.array(latency))
    finally:
        chain.end()
        rclpy.shutdown(context=context)


def _print(moving: bool, minutes: float, names: list[str], memory: np.ndarray, latency: np.ndarray) -> None:
    half = memory[len(memory) // 2 :]
    hours = half[:, 0] / 36000.0
    what = "moving" if moving else "standing"
    for i, name in enumerate(names, start=1):
        slope = np.polyfit(hours, half[:, i], 1)[0]
        grown = f"{memory[0, i]:7.1f} -> {memory[-1, i]:7.1f} MiB"
        print(f"{what:9} {minutes:4.0f} min  {name:10} {grown}, {slope:+8.1f} MiB/h")
    late = latency[len(latency) // 2 :]
    slope = np.polyfit(np.arange(len(late)) / 36000.0, late, 1)[0]
    print(
        f"{what:9} {minutes:4.0f} min  latency    {np.median(latency):7.1f} ms (median), {slope:+8.2f} ms/h", flush=True
    )


def _rss_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    for moving in (True, False):
        with tempfile.TemporaryDirectory() as folder:
            soak(moving, minutes, 1 + (os.getpid() + moving) % 100, Path(folder))


if __name__ == "__main__":
    main()
