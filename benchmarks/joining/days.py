# SPDX-License-Identifier: Apache-2.0
"""Cuts a recording into days, maps each by itself, merges the maps, and compares with one run over all of it.

    python benchmarks/joining/days.py BAG [--days 5] [--overlap 0.5] [--workers 0] [--keep FOLDER]

BAG has ground truth, as ``slam convert`` writes it. Each day has its part of the time, and a share ``--overlap`` of a
part more at its end, so that the next one sees some of the same places. Printed: ATE (rigidly aligned) of the single
run and of the merged map, in how many parts it is, and the poses of both.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.cli import slam
from slam_core.evaluation import evaluate
from slam_core.trajectory import Trajectory, read_trajectory

_SHARED = ("/tf", "/tf_static")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path, metavar="BAG")
    parser.add_argument("--days", type=int, default=5)
    parser.add_argument("--overlap", type=float, default=0.5)
    parser.add_argument("--workers", default="0")
    parser.add_argument("--keep", type=Path, help="folder for bags and results")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        days = cut(arguments.bag, arguments.days, arguments.overlap, folder)
        call("run", arguments.bag, "-o", folder / "one", "--overwrite")
        call("merge", *days, "-o", folder / "merged", "--workers", arguments.workers, "--overwrite")
        with SensorBag(arguments.bag) as opened:
            truth = opened.ground_truth(opened.agents[0])
        if truth is None:
            raise SystemExit(f"{arguments.bag} has no ground truth")
        one, merged = ate_mm(folder / "one", truth), ate_mm(folder / "merged", truth)
        events = json.loads((folder / "merged" / "summary.json").read_text())["events"]
        parts = next((line for line in events if "separate parts" in line), "one map")
        print(f"{arguments.bag.name}: one run {one[0]:.1f} mm ({one[1]} poses), {arguments.days} days merged "
              f"{merged[0]:.1f} mm ({merged[1]} poses), ratio {merged[0] / one[0]:.2f}, {parts}")  # fmt: skip


def cut(path: Path, days: int, overlap: float, folder: Path) -> list[Path]:
    """Bags of the days."""
    paths = [folder / f"day_{k + 1}.mcap" for k in range(days)]
    with BagReader(path) as bag:
        length = bag.duration_s / days
        for k, out in enumerate(paths):
            out.unlink(missing_ok=True)
            with BagWriter(out) as day:
                for message in bag.raw():
                    info = bag.topics[message.topic]
                    since = (message.stamp_ns - bag.start_ns) * 1e-9
                    inside = k * length <= since <= (k + 1 + overlap) * length
                    if inside or info.count == 1 or message.topic in _SHARED:
                        day.write_raw(message.topic, info.type_name, message.data, message.stamp_ns)
    return paths


def call(*arguments: object) -> None:
    """Run a command of slam in this process; exit code 3 (DEGRADED) has results too."""
    try:
        slam([str(a) for a in arguments] + ["-q"], standalone_mode=False)
    except SystemExit as end:
        if end.code not in (None, 0, 3):
            raise


def ate_mm(folder: Path, truth: Trajectory) -> tuple[float, int]:
    """ATE (mm) and number of poses of the first agent."""
    trajectory = read_trajectory(folder / "trajectory.tum")
    return 1e3 * evaluate(trajectory, truth).ate.rmse, len(trajectory)


if __name__ == "__main__":
    main()
