# SPDX-License-Identifier: Apache-2.0
"""``slam merge``: finished maps, and bags, of any agents and days become one map."""

from __future__ import annotations

import time
from pathlib import Path

import click
from rich.console import Console

from sjsam_node.merging.merge import merge
from sjsam_node.regions.tasks import cluster
from slam_bringup.jobs.merged_run import merged_result, parts_text, read_inputs
from slam_bringup.pipeline.configuration import system_config
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.terminal.console import LOG_NAME, Transcript, is_quiet, progress_bar, show
from slam_bringup.terminal.mapping_options import own_overrides, worker_options
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.storage.output_folder import LOGS, OutputFolder
from slam_core.version import VERSION
from slam_viewer.report.output import write_results
from slam_viewer.report.summary_table import summary_table


@click.command()
@click.argument("inputs", nargs=-1, required=True, metavar="MAP|BAG...", type=UserPath(exists=True))
@click.option("-o", "--output", type=UserPath(file_okay=False), required=True, help="folder to write")
@worker_options()
@click.option(
    "--config", type=UserPath(exists=True, dir_okay=False), help="YAML, one group per node, as in docs/parameters.md"
)
@overwrite_option("results of other maps or of another command, or results that were changed since")
def command(
    inputs: tuple[Path, ...], output: Path, scheduler: str | None, workers: int | None, config: Path | None,
    overwrite: bool,
) -> None:  # fmt: skip
    """Merge finished maps, and bags, of any agents and days to one map.

    MAP is the folder of a finished run, or its folder map; a BAG is mapped first. Places that several of them show tie
    them together; maps that share none stay parts of their own, and that is said. OUT is like that of slam run, without
    a dense model; it has the same map whatever the order of the arguments and the number of workers.
    """
    began, own = time.perf_counter(), own_overrides(config)
    system = system_config(own)
    paths = sorted(inputs, key=lambda path: str(path.resolve()))
    compile_kernels_once()
    source = " ".join(str(path.resolve()) for path in paths)
    results, transcript = OutputFolder(output, "merge", source, overwrite=overwrite), Transcript(VERSION)
    with results, transcript, results.staged() as folder:
        with cluster(scheduler, workers) as tasks, progress_bar() as progress:
            task = progress.add_task("reading and mapping", total=len(paths))

            def on_step(step: str, done: int, total: int) -> None:
                progress.update(task, description=step, completed=done, total=total)

            read = read_inputs(paths, own, tasks, on_step)
            merged = merge(read.maps, system.sjsam, tasks, on_step)
        result = merged_result(merged, [path.name for path in paths], time.perf_counter() - began, read.notes)
        with Console(stderr=True, quiet=is_quiet()).status(f"writing {output}"):
            summary = write_results(folder, result, lambda path: merged.map.save(path))
            transcript.write(folder / LOGS / LOG_NAME, summary_table(summary, output))
    for line in filter(None, (*read.notes, *merged.notes, parts_text(merged))):
        click.echo(f"slam: {line}", err=True)
    show(summary_table(summary, output))
