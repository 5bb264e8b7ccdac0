# SPDX-License-Identifier: Apache-2.0
"""``slam run``: the offline pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import click
from rich.console import Console

from sjsam_node.map_session import MapSession, Mode
from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames, parse_topics
from slam_bringup.doctor.examination import require_stereo
from slam_bringup.pipeline.configuration import choose, overrides_for, system_config, with_files
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.interrupt import MAP, Interrupt, giving_up
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.terminal.console import LOG_NAME, Transcript, is_quiet, progress_bar, show
from slam_bringup.terminal.mapping_options import (
    map_folder,
    mapping_options,
    mode_for,
    own_overrides,
    require_map,
)
from slam_bringup.terminal.run_end import end_run
from slam_core.storage.output_folder import LOGS, OutputFolder
from slam_core.version import VERSION
from slam_viewer.report.early_output import EarlyOutput
from slam_viewer.report.summary_table import summary_table
from slam_viewer.results import STOPPED


@click.command()
@mapping_options
def command(
    bag: Path, output: Path, mode: str | None, mapper: str, odometry: str, imu: str | None, config: Path | None,
    topics: tuple[str, ...], calibrations: tuple[Path, ...], base_frame: str, overwrite: bool, old_map: Path | None,
    localize_only: bool,
) -> None:  # fmt: skip
    """Map BAG without ROS: same classes as the nodes, no drops, the same bytes every time.

    BAG is a folder or file of ROS 2 (mcap, db3) or a .bag of ROS 1. Ctrl-C ends it early and writes what is mapped; an
    error on the way does too, is named, and makes the exit code 1. A run that lost most of its way ends with 3.

    With --map all results are in the frame of that map; OUT gets a map of its own, the old one is only read.
    """
    names = BagNames(parse_topics(topics), base_frame, read_rig_calibration(calibrations))
    with SensorBag(bag, names) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
        mode = mode_for(opened, mode)
    overrides = overrides_for(bag, with_files(own_overrides(config), names.calibration.parameters))
    system = choose(system_config(overrides), mode, mapper, odometry, imu)
    session = MapSession(system.sjsam, Mode.LOCALISE if localize_only else Mode.MAP)
    if (old := map_folder(old_map, localize_only=localize_only)) is not None:
        session.load(old, len).result()
    if mode != "tof":
        require_stereo(bag, names)
    compile_kernels_once()
    results, transcript = OutputFolder(output, "run", bag, overwrite=overwrite), Transcript(VERSION)
    staged = results.staged(rescue=MAP)
    with (
        session, results, transcript, giving_up(results), staged as folder,
        _saved_if_given_up(session, folder / MAP), EarlyOutput(folder, partial(_save, session)) as early,
    ):  # fmt: skip
        with Interrupt() as interrupt, progress_bar() as progress:
            task = progress.add_task(f"mapping {bag.name}", total=2 * readings)
            result, _ = run_bag(
                bag,
                system,
                mapper=mapper,
                odometry=odometry,
                names=names,
                session=session,
                on_reading=lambda: progress.advance(task),
                stopped=lambda: interrupt.asked,
                on_mapped=early.start,
            )
        require_map(result)
        result = replace(result, is_localized=localize_only)
        if interrupt.asked:
            result = replace(result, events=(STOPPED, *result.events))
        with Console(stderr=True, quiet=is_quiet()).status(f"writing {output}"):
            summary = early.write_rest(result, pictures=not interrupt.asked)
            transcript.write(folder / LOGS / LOG_NAME, summary_table(summary, output))
    show(summary_table(summary, output))
    end_run(summary, output, stopped=interrupt.asked)


def _save(session: MapSession, path: Path) -> None:
    session.save(path, is_last=True).result()


@contextmanager
def _saved_if_given_up(session: MapSession, path: Path) -> Iterator[None]:
    """A user who does not want to wait for the rest keeps the map."""
    try:
        yield
    except KeyboardInterrupt:
        if len(session.snapshot) and not path.exists():
            _save(session, path)
        raise
