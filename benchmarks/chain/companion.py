# SPDX-License-Identifier: Apache-2.0
"""Somebody walks ahead of the rig at its own pace: the error that this makes, and what is said of it.

    python benchmarks/chain/companion.py [SCENARIO ...] [--keep FOLDER] [--every N] [--only RUN ...]

Each SCENARIO (small_room by default) is rendered with a companion under the profile real and mapped by stereo alone,
with the IMU, with scan odometry and with both. Bags are kept in FOLDER and used again. Counts are
the filter's; events say when its state changed.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table
from self_calibration import scale_error_percent
from slam_bringup.commands.simulate import BagOptions, write_bag

from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_simulation import Scenario
from slam_viewer.results import RunResult

RUNS = {"stereo": ("none", "off"), "imu": ("none", None), "ndt": ("ndt", "off"), "ndt, imu": ("ndt", None)}
"""Scan odometry and use of the IMU by the name of a run."""
HEADINGS = ("scenario", "run", "frames", "ATE mm", "ANEES", "scale %", "filter: ATE mm", "counts", "events")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=["small_room"], metavar="SCENARIO")
    parser.add_argument("--keep", type=Path, help="folder for the bags")
    parser.add_argument("--every", type=int, default=1, help="keep only every n-th frame")
    parser.add_argument("--only", nargs="+", default=list(RUNS), choices=RUNS)
    arguments = parser.parse_args()
    table = Table(title="somebody walks ahead of the rig")
    for heading in HEADINGS:
        table.add_column(heading)
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.scenarios:
            bag = rendered(name, arguments.keep or Path(temporary), arguments.every)
            for run in arguments.only:
                table.add_row(name, run, *cells(mapped(bag, *RUNS[run])))
    Console(width=180).print(table)


def rendered(name: str, folder: Path, every: int) -> Path:
    """The bag of a scenario with a companion."""
    bag = folder / f"{Path(name).stem}_companion_{every}"
    if not bag.exists():
        plan = Scenario.load(name).with_profile("real")
        realism = plan.suite.realism
        realism = replace(realism, moving=replace(realism.moving, companions=1))
        write_bag(replace(plan, suite=replace(plan.suite, realism=realism)), bag, BagOptions(every=every))
    return bag


def mapped(bag: Path, odometry: str, imu: str | None) -> RunResult:
    """Result of one run, without a dense model."""
    system = choose(load_system_config(None, bag), "stereo", "sjsam", odometry, imu)
    without_model = replace(system.dense_mapper, use_stereo=False, use_tof=False)
    return run_bag(bag, replace(system, dense_mapper=without_model), odometry=odometry)[0]


def cells(result: RunResult) -> list[str]:
    agent = result.agents[0]
    joined, filtered = agent.evaluation(), agent.evaluation(agent.filtered)
    assert joined is not None
    assert filtered is not None
    return [
        str(result.frames), f"{1e3 * joined.ate.rmse:.1f}", f"{joined.anees:.2f}", f"{scale_error_percent(agent):+.2f}",
        f"{1e3 * filtered.ate.rmse:.1f}", str(dict(result.rejections)), "\n".join(result.events[:4]),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
