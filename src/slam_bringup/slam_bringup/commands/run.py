# SPDX-License-Identifier: Apache-2.0
"""``slam run``: the offline pipeline, on one recording or on many at once."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import click
from rich.console import Console

from sjsam_node.regions.tasks import cluster
from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_topics import BagNames, parse_topics
from slam_bringup.jobs.many_runs import folder_names, outcomes_table, run_many
from slam_bringup.jobs.recording_run import RecordingRun, RunOptions, Watch
from slam_bringup.processes.interrupt import INTERRUPTED, Interrupt
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.terminal.console import is_quiet, progress_bar, show
from slam_bringup.terminal.mapping_options import mapping_options, own_overrides, worker_options
from slam_bringup.terminal.paths import rig_cameras
from slam_bringup.terminal.run_end import DEGRADED, FAILED, end_run
from slam_viewer.report.summary_table import summary_table


@click.command()
@mapping_options(many=True)
@worker_options("several BAGs: ")
def command(
    bags: tuple[Path, ...], output: Path, mode: str | None, mapper: str, odometry: str, imu: str | None,
    config: Path | None, topics: tuple[str, ...], calibrations: tuple[Path, ...], base_frame: str, overwrite: bool,
    old_map: Path | None, localize_only: bool, scheduler: str | None, workers: int | None,
) -> None:  # fmt: skip
    """Map BAG without ROS: same classes as the nodes, no drops, the same bytes every time.

    BAG is a folder or file of ROS 2 (mcap, db3) or a .bag of ROS 1. Ctrl-C ends it early and writes what is mapped; an
    error on the way does too, is named, and makes the exit code 1. A run that lost most of its way ends with 3.

    Several BAGs are mapped at once, one per worker, each into a folder of its name in OUT, with the same bytes as one
    by one; one that fails stops no other, and makes the exit code 1 in the end. slam merge makes one map of them.

    With --map all results are in the frame of that map; OUT gets a map of its own, the old one is only read.
    """
    names = BagNames(parse_topics(topics), base_frame, read_rig_calibration(calibrations), rig_cameras())
    options = RunOptions(
        mode, mapper, odometry, imu, own_overrides(config), names, overwrite, old_map, localize_only
    )  # fmt: skip
    if len(bags) > 1:
        _run_many(bags, output, options, scheduler, workers)
        return
    if scheduler is not None or workers is not None:
        raise ValueError("--workers and --scheduler are for several recordings: one is mapped by one process")
    run = RecordingRun(bags[0], output, options)
    compile_kernels_once()
    summary, stopped = run.write(_OnTerminal(bags[0].name, output))
    show(summary_table(summary, output))
    end_run(summary, output, stopped=stopped)


@dataclass(frozen=True)
class _OnTerminal:
    """Shows how far the run of a recording is, and ends it early on Ctrl-C."""

    name: str
    output: Path

    @contextmanager
    def mapping(self, readings: int) -> Iterator[Watch]:
        """A bar of readings."""
        with Interrupt() as interrupt, progress_bar() as progress:
            task = progress.add_task(f"mapping {self.name}", total=readings)
            yield Watch(lambda: progress.advance(task), lambda: interrupt.asked)

    def writing(self) -> AbstractContextManager[object]:
        """A line."""
        return Console(stderr=True, quiet=is_quiet()).status(f"writing {self.output}")


def _run_many(
    bags: Sequence[Path], output: Path, options: RunOptions, scheduler: str | None, workers: int | None
) -> None:
    """Map several recordings, show one table, and end with the exit code of the worst."""
    folder_names(bags)  # what is wrong with the names shows before anything is started
    compile_kernels_once()
    written: list[str] = []
    try:
        with cluster(scheduler, workers) as tasks, progress_bar() as progress:
            task = progress.add_task(f"mapping {len(bags)} recordings", total=None)
            outcomes = run_many(
                bags, output, options, tasks,
                lambda at, total: progress.update(task, completed=at, total=total),
                written.append,
            )  # fmt: skip
    except KeyboardInterrupt:
        finished = ", ".join(dict.fromkeys(written)) or "none"
        click.echo(f"slam: stopped; {output} holds the results of: {finished}", err=True)
        sys.exit(INTERRUPTED)
    show(outcomes_table(outcomes))
    for one in outcomes:
        if one.reason:
            click.echo(f"slam: {one.bag}: {one.reason}", err=True)
    if any(one.reason for one in outcomes):
        sys.exit(FAILED)
    if any(one.summary and one.summary["degraded"] for one in outcomes):
        sys.exit(DEGRADED)
