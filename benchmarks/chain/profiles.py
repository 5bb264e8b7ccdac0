# SPDX-License-Identifier: Apache-2.0
"""Maps of the simulator's profile real, which new users get, beside those of its profile ideal: the same rooms.

    python benchmarks/chain/profiles.py IDEAL REAL [NAME[:MODE] ...]

IDEAL and REAL are folders of bags (``slam simulate NAME -o IDEAL/NAME --profile ideal``). MODE is stereo (the default),
tof, replace or fuse. Marks: 3 times the ATE, ANEES 0.5 to 2.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table
from self_calibration import scale_error_percent

from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import Evaluation
from slam_viewer.results import AgentResult

DEFAULT = tuple(f"{name}{mode}" for mode in ("", ":fuse") for name in ("workshop_rig", "small_room", "conference"))
HEADINGS = ("run", "ideal: ATE mm", "ANEES", "real: ATE mm", "ratio", "scale %", "ANEES", "filter: ATE mm", "ANEES")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs=2, type=Path, metavar="IDEAL REAL")
    parser.add_argument("runs", nargs="*", default=DEFAULT, metavar="NAME[:MODE]")
    arguments = parser.parse_args()
    table = Table(title="profile real beside profile ideal")
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading == "run" else "right")
    for run in arguments.runs:
        name, _, mode = run.partition(":")
        ideal, real = (mapped(folder / name, mode or "stereo") for folder in arguments.folders)
        table.add_row(run, *cells(ideal, real))
    Console(width=140).print(table)


def mapped(bag: Path, mode: str) -> AgentResult:
    system = choose(load_system_config(None, bag), mode, "sjsam", "none")
    without_model = replace(system.dense_mapper, use_stereo=False, use_tof=False)
    return run_bag(bag, replace(system, dense_mapper=without_model))[0].agents[0]


def cells(ideal: AgentResult, real: AgentResult) -> list[str]:
    at_best, joined, filtered = _evaluated(ideal), _evaluated(real), _evaluated(real, alone=True)
    return [
        f"{1e3 * at_best.ate.rmse:.1f}", f"{at_best.anees:.2f}", f"{1e3 * joined.ate.rmse:.1f}",
        f"{joined.ate.rmse / at_best.ate.rmse:.1f}", f"{scale_error_percent(real):+.2f}", f"{joined.anees:.2f}",
        f"{1e3 * filtered.ate.rmse:.1f}", f"{filtered.anees:.2f}",
    ]  # fmt: skip


def _evaluated(agent: AgentResult, alone: bool = False) -> Evaluation:
    found = agent.evaluation(agent.filtered) if alone else agent.evaluation()
    assert found is not None
    return found


if __name__ == "__main__":
    main()
