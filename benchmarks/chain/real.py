# SPDX-License-Identifier: Apache-2.0
"""The whole chain on public recordings: convert, map offline, compare with ground truth.

    python benchmarks/chain/real.py [NAME ...] [--keep FOLDER]

NAME: kitti, euroc, redkitchen, demo (default all). Prints one row per run: filter alone, after joining, scan odometry.
ANEES first as it is; for recordings then with what else errs, truth and calibration (``slam_experiments.benchmark``).
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import EXACT_TRUTH, evaluate
from slam_core.trajectory import Trajectory
from slam_experiments.benchmark.truth import TRUTH, with_calibration_error
from slam_viewer.report.output import write_results
from slam_viewer.results import AgentResult, summarise

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data"))
EUROC = DATA / "euroc_v101_visnav100" / "euroc_V1"
SOURCES = {
    "kitti": ["kitti", DATA / "kitti_stereo_51x2" / "KITTI_sequence_1"],
    "euroc": ["euroc", EUROC, "--calibration", DATA / "euroc_v101_micro95" / "MicroEurocDataset",
              "--ground-truth", DATA / "traj_gt_openvins" / "euroc_mav" / "V1_01_easy.txt"],
    "redkitchen": ["rgbd", DATA / "rgbd_tsdf_1000" / "data"],
}  # fmt: skip
RUNS = {"kitti": ("stereo", "none"), "euroc": ("stereo", "none"), "redkitchen": ("tof", "ndt"), "demo": ("fuse", "ndt")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(RUNS), metavar="NAME")
    parser.add_argument("--keep", type=Path, help="folder for bags and results")
    arguments = parser.parse_args()
    table = Table(title="chain on recordings, against ground truth")
    for heading in ("run", "frames", "submaps", "closures", "times lost", "x real time"):
        table.add_column(heading, justify="right")
    for heading in ("joined", "filter alone", "scan odometry"):
        table.add_column(f"{heading}: ATE m, drift %, ANEES, with truth's errors", justify="right")
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        for name in track(arguments.names, description="mapping", console=Console(stderr=True)):
            table.add_row(name, *row(name, folder))
    Console(width=200).print(table)


def row(name: str, folder: Path) -> list[str]:
    mode, odometry = RUNS[name]
    system = choose(load_system_config(None), mode, "sjsam", odometry)
    result, session = run_bag(bag_of(name, folder), system, odometry=odometry)
    write_results(folder / name, result, lambda path: session.save(path).result())
    summary, agent = summarise(result), result.agents[0]
    lost = sum("LOST" in event for event in result.events)
    counts = [summary["frames"], summary["submaps"], summary["loop_closures"], lost]
    accuracies = [accuracy(name, agent, t) for t in (agent.trajectory, agent.filtered, agent.scan_odometry)]
    return [*map(str, counts), f"{summary['real_time_factor']:.1f}", *accuracies]


def bag_of(name: str, folder: Path) -> Path:
    if name not in SOURCES:
        return ROOT / "bags" / name
    bag = folder / f"{name}.mcap"
    if not bag.exists():
        slam(["convert", *map(str, SOURCES[name]), "-o", str(bag)], standalone_mode=False)
    return bag


def accuracy(name: str, agent: AgentResult, trajectory: Trajectory) -> str:
    e = agent.evaluation(trajectory)
    if e is None or e.anees is None:
        return ""
    own = f"{e.ate.rmse:.4f}, {e.drift_percent:.2f}, {e.anees:.1f}"
    if name not in SOURCES:  # simulated: truth and calibration are exact
        return own
    in_all = evaluate(with_calibration_error(trajectory), agent.truth, accuracy=TRUTH.get(name, EXACT_TRUTH))
    return f"{own}, {in_all.anees:.1f}"


if __name__ == "__main__":
    main()
