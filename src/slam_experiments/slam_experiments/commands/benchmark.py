# SPDX-License-Identifier: Apache-2.0
"""``slam benchmark``: every recording and its variants, beside other programs; the judge of a change."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from slam_bringup.pipeline.configuration import load_system_config
from slam_bringup.terminal.console import progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.storage.files import atomic_text, read_json, read_text
from slam_core.storage.output_folder import OutputFolder
from slam_experiments.benchmark.cases import OURS, Case, cases_of
from slam_experiments.benchmark.orbslam3 import INSTALL, is_there
from slam_experiments.benchmark.recording_sets import sets_of
from slam_experiments.benchmark.summary import (
    CHANGE_HEADINGS,
    HEADINGS,
    BeforeAndAfter,
    Row,
    as_csv,
    as_markdown,
    compare,
    in_common,
    is_row,
    table,
)
from slam_experiments.benchmark.variants import VARIANTS
from slam_experiments.runner import run_jobs

_RESULT = "benchmark.json"
_WIDTH = 140
"""Of tables that no terminal shows."""


@click.command("benchmark")
@click.argument("data", metavar="DATA_FOLDER", type=UserPath(exists=True, file_okay=False))
@click.option("-o", "--output", metavar="OUT", required=True, type=UserPath(file_okay=False), help="folder to write")
@click.option("--only", "names", multiple=True, metavar="NAME", help="only this recording (may be repeated)")
@click.option(
    "--variants", multiple=True, type=click.Choice(VARIANTS), help="only this variant of each (may be repeated)"
)
@click.option("--peers", is_flag=True, help="ORB-SLAM3 and SIFT + PnP on the same pictures too")
@click.option(
    "--orbslam3", "python", metavar="PYTHON", default=sys.executable, help="interpreter that has orbslam3-python"
)
@click.option(
    "--config",
    "config_file",
    metavar="FILE",
    type=UserPath(exists=True, dir_okay=False),
    help="parameters of the nodes",
)
@click.option(
    "--against", metavar="OLD.json", type=UserPath(exists=True, dir_okay=False),
    help="benchmark.json of the state before: says what got better and worse; exit code 1 if the rule is broken",
)  # fmt: skip
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="processes on this machine")
@overwrite_option("results that were changed since they were written")
def command(
    data: Path, output: Path, names: tuple[str, ...], variants: tuple[str, ...], peers: bool, python: str,
    config_file: Path | None, against: Path | None, workers: int, overwrite: bool,
) -> None:  # fmt: skip
    """Map every recording in DATA_FOLDER and its variants, and compare with ground truth.

    DATA_FOLDER holds the public recordings that docs/results.md names, or bags with ground truth. OUT gets
    benchmark.json and .csv (every case) and benchmark.md (median and worst); OUT/cache keeps bags and results, so that
    a second run does only what is missing or what changed code asks for.
    """
    folder = OutputFolder(output, "benchmark", overwrite=overwrite, last=_RESULT)
    old = None if against is None else _rows_in(against)
    if peers and not is_there(python):
        click.echo(f"slam: ORB-SLAM3 is left out, {python} has no orbslam3-python: {INSTALL}", err=True)
        python = ""
    load_system_config(config_file)  # refuses what is wrong in it, before anything runs
    config = "" if config_file is None else read_text(config_file)
    cases = [
        case
        for recording in sets_of(data, names).values()
        for case in cases_of(recording, variants or VARIANTS, config=config, peers=peers, orbslam3_python=python)
    ]
    if old is not None:
        in_common(old, [_row(case) for case in cases], OURS)  # refused before anything runs
    with folder:
        rows = _run(cases, output / "cache", workers)
        _write(folder, rows, None)  # what took the time is kept, whatever the comparison says
        comparison = None if old is None else compare(old, rows, OURS)
        if comparison is not None:
            _write(folder, rows, comparison)
    _show(rows, comparison)
    if comparison is not None and not comparison.is_accepted:
        sys.exit(1)


def _rows_in(path: Path) -> list[Row]:
    rows: Any = read_json(path)
    if not isinstance(rows, list) or not all(map(is_row, rows)):
        raise ValueError(f"{path} is no benchmark.json of slam benchmark")
    return rows


def _run(cases: Sequence[Case], cache: Path, workers: int) -> list[Row]:
    with progress_bar() as progress:
        task = progress.add_task("recordings", total=len(cases))
        wanted = {case.job for case in cases}
        results = run_jobs(
            [case.job for case in cases], cache, workers, None, lambda job: progress.advance(task, job in wanted)
        )
    return [{**_row(case), **results[case.job].values} for case in cases]


def _row(case: Case) -> Row:
    return {"recording": case.recording, "variant": case.variant, "program": case.program, "run": case.run}


def _write(folder: OutputFolder, rows: Sequence[Row], comparison: BeforeAndAfter | None) -> None:
    with folder.staged() as staged:
        atomic_text(staged / _RESULT, json.dumps(rows, indent=1) + "\n")
        atomic_text(staged / "benchmark.csv", as_csv(rows))
        atomic_text(staged / "benchmark.md", _page(rows, comparison))


def _page(rows: Sequence[Row], comparison: BeforeAndAfter | None) -> str:
    text = "Median, worst over the variants.\n\n" + as_markdown(HEADINGS, table(rows))
    if comparison is None:
        return text
    return f"{text}\n{as_markdown(CHANGE_HEADINGS, comparison.lines)}\n{comparison.conclusion}\n"


def _show(rows: Sequence[Row], comparison: BeforeAndAfter | None) -> None:
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    console.print(_table("recordings in variants: median, worst", HEADINGS, table(rows)))
    if comparison is not None:
        console.print(_table("before and after", CHANGE_HEADINGS, comparison.lines))
        console.print(comparison.conclusion)


def _table(title: str, headings: Sequence[str], lines: Sequence[Sequence[str]]) -> Table:
    shown = Table(title=title)
    for heading in headings:
        shown.add_column(heading, justify="left" if heading in ("recording", "program", "verdict") else "right")
    for line in lines:
        shown.add_row(*line)
    return shown
