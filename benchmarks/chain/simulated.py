"""The thesis's experiments on simulated bags (chapter 9): render, map offline, compare with the truth.

    python benchmarks/chain/simulated.py [SCENARIO[/EVERY][:MODE] ...] [--keep FOLDER]

EVERY keeps each n-th frame, MODE is stereo, tof, replace or fuse. Bags are kept in FOLDER and used again.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from slam_bringup.cli import slam
from slam_bringup.configuration import choose, load_system_config
from slam_bringup.pipeline import run_bag
from slam_bringup.results import summarise
from slam_core.evaluation import Evaluation

DEFAULT = (
    "workshop_rig", "workshop_handheld", "fireman_10hz", "fireman_5hz", "sweep", "conference", "two_rooms/2",
    "figure_eight/4", "five_rooms/4", "small_room/3:stereo", "small_room/3:tof", "small_room/3:replace",
    "small_room/3:fuse",
)  # fmt: skip
HEADINGS = (
    "run", "frames", "path m", "submaps", "closures", "lost", "landmarks", "ATE mm", "end mm", "end deg", "ANEES",
    "filter: ATE mm", "ANEES", "ms features", "ms ekf", "ms sjsam", "x real time",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=DEFAULT, metavar="RUN")
    parser.add_argument("--keep", type=Path, help="folder for the bags")
    arguments = parser.parse_args()
    table = Table(title="simulated experiments, against the truth")
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    with tempfile.TemporaryDirectory() as scratch:
        for run in track(arguments.runs, description="mapping", console=Console(stderr=True)):
            table.add_row(run, *row(run, arguments.keep or Path(scratch)))
    Console(width=210).print(table)


def row(run: str, folder: Path) -> list[str]:
    name, _, mode = run.partition(":")
    mode = mode or "stereo"
    bag = bag_of(name, folder)
    result, _ = run_bag(bag, choose(load_system_config(None), mode, "sjsam", "none"))
    summary, agent = summarise(result), result.agents[0]
    joined, filtered = agent.evaluation(), agent.evaluation(agent.filtered)
    assert joined is not None
    assert filtered is not None
    counts = [summary[key] for key in ("submaps", "loop_closures")]
    lost = sum("LOST" in event for event in result.events)
    times = [np.median(result.stage_ms.get(stage, [0.0])) for stage in ("features", "ekf", "sjsam")]
    return [
        str(summary["frames"]), f"{joined.truth_length_m:.1f}", *map(str, counts), str(lost), str(summary["landmarks"]),
        *accuracy(joined), f"{1e3 * filtered.ate.rmse:.1f}", f"{filtered.anees:.2f}", *(f"{t:.0f}" for t in times),
        f"{summary['real_time_factor']:.1f}",
    ]  # fmt: skip


def accuracy(e: Evaluation) -> list[str]:
    return [
        f"{1e3 * e.ate.rmse:.1f}", f"{1e3 * e.end_error_m:.1f}", f"{e.end_error_deg:.3f}", f"{e.anees:.2f}",
    ]  # fmt: skip


def bag_of(name: str, folder: Path) -> Path:
    scenario, _, every = name.partition("/")
    bag = folder / f"{name.replace('/', '_every_')}.mcap"
    if not bag.exists():
        command = ["simulate", scenario, "-o", str(bag), "--images", "jpeg", "--compact", "--every", every or "1"]
        slam(command, standalone_mode=False)
    return bag


if __name__ == "__main__":
    main()
