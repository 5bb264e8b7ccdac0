# SPDX-License-Identifier: Apache-2.0
"""What joining costs submap by submap, with all that the node publishes, and what comes of it.

    python benchmarks/joining/per_submap.py RECORDING.pickle ... [--unread] [--every]

The recordings come from ``recorded_submaps.py``. CPU time of this process per submap: ``GlobalMap.add``, and the pose,
the landmarks and their ellipsoids, the paths and the graph as the node publishes them after it. ``--unread`` reads only
at the end. ``all`` is the joining's share of the sensor's time, with settling, saving and the central map. ``--every``
prints each submap. Of several recordings each is joined in a process of its own, for the sake of memory.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np
import problems  # noqa: F401 - sets the import path
from recorded_submaps import Recording, load

from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from slam_core.evaluation import evaluate
from slam_core.trajectory import Trajectory

CONFIG = GlobalMapConfig()
HEADINGS = (
    "run", "submaps", "landmarks", "add mean ms", "read mean", "mean ms", "95 %", "max", "20-40", "last 20",
    "MB/submap", "finish s", "all % of sensor", "of features", "closures", "parts", "chi2 / redundancy", "ATE mm",
    "ANEES", "filter ATE",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--unread", action="store_true")
    parser.add_argument("--every", action="store_true")
    parser.add_argument("--ties", type=int)
    parser.add_argument("--most", type=int, default=10**6, help="submaps of each recording, at most")
    arguments = parser.parse_args()
    global CONFIG
    CONFIG = GlobalMapConfig(ties=arguments.ties) if arguments.ties else GlobalMapConfig()
    if len(arguments.recordings) == 1:
        measure(arguments.recordings[0], not arguments.unread, arguments.every, arguments.most)
        return
    for k, path in enumerate(arguments.recordings):
        options = ["--unread"] * arguments.unread + ["--every"] * arguments.every + ["--most", str(arguments.most)]
        done = subprocess.run(
            [sys.executable, __file__, str(path), *options], capture_output=True, text=True, check=False
        )
        lines = (done.stdout or done.stderr[-2000:]).splitlines()
        print("\n".join(lines if k == 0 or arguments.every else lines[1:]), flush=True)


def measure(path: Path, is_read: bool, every: bool, most: int) -> None:
    recording, submaps = load(path)
    warm_up(path)
    global_map = GlobalMap(CONFIG)
    adding, reading, memory = [], [], []
    reports: list[JoinReport] = []
    for submap in islice(submaps, most):
        began = time.process_time()
        reports.append(global_map.add(submap))
        added = time.process_time()
        if is_read:
            publish(global_map, submap.agent)
        reading.append(time.process_time() - added)
        adding.append(added - began)
        memory.append(resident_mb())
        if every:
            r = reports[-1]
            print(
                f"{len(adding):4d} add {1e3 * adding[-1]:8.1f} read {1e3 * reading[-1]:8.1f} ms {memory[-1]:7.1f} MB"
                f" landmarks {len(submap.landmarks):4d} closures {len(r.closures):3d} dropped {r.dropped:4d}"
                f" iterations {r.iterations} {'redundant' * r.redundant}",
                flush=True,
            )
    live = closed(global_map)
    began = time.process_time()
    final = global_map.rebuilt_in_time_order()
    with tempfile.TemporaryDirectory() as folder:
        final.save(Path(folder) / "map")
    finish = time.process_time() - began
    print_row(path.stem, recording, final, reports, np.array(adding), np.array(reading), memory, finish, live)


def print_row(name: str, recording: Recording, final: GlobalMap, reports: list[JoinReport], adding: np.ndarray,
              reading: np.ndarray, memory: list[float], finish: float, live: int) -> None:  # fmt: skip
    ms = 1e3 * (adding + reading)
    ate, anees, filtered = accuracy(recording, final)
    growth = (memory[-1] - memory[40]) / max(len(memory) - 41, 1) if len(memory) > 60 else np.nan
    total = float(adding.sum() + reading.sum() + finish)
    span = recording.sensor_s * len(adding) / recording.count
    features = recording.features_s * len(adding) / recording.count
    cells = (
        name, len(adding), len(final.landmarks().ids), f"{1e3 * adding.mean():.0f}", f"{1e3 * reading.mean():.0f}",
        f"{ms.mean():.0f}", f"{np.percentile(ms, 95):.0f}", f"{ms.max():.0f}", f"{stretch(ms, 20, 40):.0f}",
        f"{ms[-20:].mean():.0f}", f"{growth:.2f}", f"{finish:.2f}", f"{100 * total / span:.1f}",
        f"{total / features:.2f}", f"{sum(len(r.closures) for r in reports)}, {live}, {closed(final)}",
        final.components, "{:.0f}/{}".format(*final.state.totals()),
        ", ".join(f"{a:.1f}" for a in ate), ", ".join(f"{a:.2f}" for a in anees),
        ", ".join(f"{a:.1f}" for a in filtered),
    )  # fmt: skip
    print(" | ".join(HEADINGS))
    print(" | ".join(map(str, cells)), flush=True)


def stretch(ms: np.ndarray, first: int, last: int) -> float:
    return float(ms[first:last].mean()) if len(ms) >= last else np.nan


def closed(global_map: GlobalMap) -> int:
    return len(global_map.snapshot().closures)


def accuracy(recording: Recording, final: GlobalMap) -> tuple[list[float], list[float], list[float]]:
    """ATE mm and ANEES of every agent that has ground truth, and the filter's own ATE."""
    ate, anees, filtered = [], [], []
    for agent, truth in recording.truth.items():
        joined = Trajectory.from_estimates(final.trajectory(agent))
        if len(truth) > 1 and len(joined) > 1:
            e = evaluate(joined, truth)
            ate.append(1e3 * e.ate.rmse)
            anees.append(np.nan if e.anees is None else e.anees)
            filtered.append(1e3 * evaluate(recording.filtered[agent], truth).ate.rmse)
    return ate, anees, filtered


def publish(global_map: GlobalMap, agent: str) -> None:
    """Ask for what the node publishes after a submap; making the messages of it is not joining."""
    global_map.end_pose(agent)
    global_map.landmarks()
    global_map.path() if hasattr(global_map, "path") else global_map.trajectory()
    global_map.map_to_odom(agent)
    global_map.snapshot().skeleton_lines()


def warm_up(path: Path) -> None:
    """Load the compiled kernels."""
    global_map = GlobalMap(CONFIG)
    for submap in islice(load(path)[1], 3):
        global_map.add(submap)
        publish(global_map, submap.agent)
    global_map.settle()


def resident_mb() -> float:
    """Memory of this process without what it maps from files, which the system takes back when it needs it."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024.0
    return 0.0


if __name__ == "__main__":
    main()
