# SPDX-License-Identifier: Apache-2.0
"""``slam plane``: SLAM in the plane on range-bearing logs, by EKF, SAM or joined submaps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.storage.files import atomic_text
from slam_core.storage.output_folder import OutputFolder
from slam_experiments.planar.ekf import PlanarEkf
from slam_experiments.planar.log import PlanarLog
from slam_experiments.planar.mapping import ASSOCIATIONS, METHODS, map_log
from slam_experiments.planar.output import draw, summarise, write_tables
from slam_experiments.planar.readers import read_log


@click.command("plane")
@click.argument("log", type=UserPath(exists=True))
@click.option("-o", "--output", metavar="OUT", required=True, type=UserPath(file_okay=False))
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="sam",
    show_default=True,
    help="one filter, everything smoothed at once, or submaps joined",
)
@click.option(
    "--association",
    type=click.Choice(ASSOCIATIONS),
    default="known",
    show_default=True,
    help="known: by the log's own names of the landmarks; hypotheses: searched, several followed over the whole drive;"
    " the others: searched step by step",
)
@click.option(
    "--filter",
    "implementation",
    type=click.Choice(("own", "filterpy")),
    default="own",
    show_default=True,
    help="with --method ekf: our filter, or as a check of it filterpy's, in the standard error state and slower",
)
@click.option("--robot", metavar="NAME", help="one robot of a log of several")
@overwrite_option("results of another log, or results that were changed since")
def command(
    log: Path, output: Path, method: str, association: str, implementation: str, robot: str | None, overwrite: bool
) -> None:
    """Map the range-bearing LOG of one or several robots.

    LOG is a folder of UTIAS MRCLAM, Lost in the Woods (dataset2.mat), or a text file of GTSAM (victoria_park.txt).
    Writes summary.json, map.png, path_<robot>.csv with covariances and landmarks.csv to OUT.
    """
    results = OutputFolder(output, "plane", log, overwrite=overwrite)
    read = _only(read_log(log), robot)
    if method == "submaps" and association not in ("known", "hypotheses"):
        raise ValueError("--method submaps joins by names of the landmarks: --association known or hypotheses")
    if implementation == "filterpy" and method != "ekf":
        raise ValueError("--filter filterpy takes the place of the filter of --method ekf: give that too")
    with results:
        result = map_log(read, method, association, _filter_of(implementation))
        summary = summarise(read, result, method, association)
        with results.staged() as folder:
            write_tables(folder, read, result)
            draw(folder / "map.png", read, result)
            atomic_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    Console().print(_table(summary))


def _filter_of(implementation: str) -> type[PlanarEkf]:
    if implementation == "own":
        return PlanarEkf
    from slam_experiments.planar.filterpy_ekf import (
        FilterpyPlanarEkf,  # a third of a second to import, and needed here alone
    )

    return FilterpyPlanarEkf


def _only(log: PlanarLog, name: str | None) -> PlanarLog:
    if name is None:
        return log
    chosen = tuple(robot for robot in log.robots if robot.name == name)
    if not chosen:
        raise ValueError(f"no robot {name} in the log; there are: {', '.join(r.name for r in log.robots)}")
    return replace(log, robots=chosen)


def _table(summary: dict[str, object]) -> Table:
    table = Table(title=f"{summary['log']}: {summary['landmarks']} landmarks, {summary['method']}")
    for heading in ("robot", "steps", "ATE m", "RMSE m", "RMSE deg", "ANEES", "dead reckoning RMSE m"):
        table.add_column(heading, justify="right")
    robots = summary["robots"]
    assert isinstance(robots, dict)
    for name, r in robots.items():
        keys = ("ate_m", "rmse_m", "rmse_deg", "anees", "dead_reckoning_rmse_m")
        table.add_row(name, str(r["steps"]), *(f"{r[key]:.3f}" if key in r else "" for key in keys))
    return table
