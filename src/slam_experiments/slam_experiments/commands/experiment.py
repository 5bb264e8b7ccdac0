# SPDX-License-Identifier: Apache-2.0
"""``slam experiment``: the thesis's experiments on simulated rooms, beside the thesis's own figures."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from slam_bringup.terminal.console import progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.storage.files import atomic_text
from slam_core.storage.output_folder import OutputFolder
from slam_experiments.catalogue import chosen, listing
from slam_experiments.findings import Experiment, as_json
from slam_experiments.job import in_order
from slam_experiments.page import write_markdown, write_page
from slam_experiments.runner import run_jobs


@click.command(epilog=f"\b\nExperiments:\n{listing()}")
@click.argument("experiments", nargs=-1, metavar="NAME...|all", callback=lambda ctx, parameter, names: chosen(names))
@click.option("-o", "--output", metavar="OUT", required=True, type=UserPath(file_okay=False), help="folder to write")
@click.option("--quick", is_flag=True, help="short runs that show that everything works; held to no mark")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="processes on this machine")
@click.option("--scheduler", help="address of a Dask scheduler, tcp://HOST:8786; its workers must see OUT")
@overwrite_option("results that were changed since they were written")
def command(
    experiments: list[Experiment], output: Path, quick: bool, workers: int, scheduler: str | None, overwrite: bool
) -> None:
    """Run the experiments NAME of the thesis, or all of them.

    OUT holds experiments.html, .md and .json, the figures, and in OUT/cache what was computed: a second run redoes
    only what depends on changed code.
    """
    folder = OutputFolder(output, "experiment", overwrite=overwrite, last="experiments.json")
    wanted = {e.name: e.jobs(quick) for e in experiments}
    jobs = list({job.digest: job for needed in wanted.values() for job in needed.values()}.values())
    with folder:
        with progress_bar() as progress:
            task = progress.add_task("experiments", total=len(in_order(jobs)))
            results = run_jobs(jobs, output / "cache", workers, scheduler, lambda job: progress.advance(task))
        with folder.staged() as staged:
            findings = []
            for experiment in experiments:
                found = experiment.report({name: results[job] for name, job in wanted[experiment.name].items()})
                findings.append(as_json(experiment, found, staged, quick=quick))
            atomic_text(staged / "experiments.json", json.dumps(findings, indent=1) + "\n")
            write_page(staged / "experiments.html", findings)
            write_markdown(staged / "experiments.md", findings)
    Console().print(_table(findings))
    Console().print(f"written to {output / 'experiments.html'}")
    if any(c["met"] is False for entry in findings for c in entry["comparisons"]):
        sys.exit(1)


def _table(findings: list[dict[str, object]]) -> Table:
    """Every comparison with the thesis, for the console."""
    table = Table(title="ours beside the thesis's")
    for heading in ("experiment", "quantity", "thesis", "ours", "mark", "met"):
        table.add_column(heading)
    for entry in findings:
        comparisons = entry["comparisons"]
        assert isinstance(comparisons, list)
        for c in comparisons:
            met = {None: "", True: "yes", False: "NO"}[c["met"]]
            table.add_row(str(entry["name"]), c["quantity"], c["thesis"], c["ours"], c["mark"], met)
    return table
