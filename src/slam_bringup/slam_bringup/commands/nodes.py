# SPDX-License-Identifier: Apache-2.0
"""``slam nodes``: the pipeline through the real ROS nodes."""

from __future__ import annotations

import socket
from pathlib import Path

import click

from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames, parse_topics
from slam_bringup.doctor.examination import require_stereo
from slam_bringup.pipeline.configuration import choose, overrides_for, system_config, with_files
from slam_bringup.processes.interrupt import MAP, Interrupt, giving_up
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.processes.online_run import run_nodes
from slam_bringup.processes.start_map import StartMap
from slam_bringup.terminal.console import LOG_NAME, Transcript, progress_bar, show
from slam_bringup.terminal.mapping_options import (
    map_folder,
    mapping_options,
    mode_for,
    own_overrides,
    require_map,
)
from slam_bringup.terminal.paths import rig_cameras
from slam_bringup.terminal.run_end import end_run
from slam_core.storage.output_folder import LOGS, OutputFolder
from slam_core.version import VERSION
from slam_viewer.report.summary_table import summary_table

_PAGE_PORT = 8080
"""Port of the page, where it is free."""


@click.command()
@mapping_options()
@click.option("--rate", type=click.FloatRange(min=0.0), default=0.0, help="speed of the replay [as fast as it goes]")
@click.option("--view", is_flag=True, help="show the nodes at work on a page in the browser")
@click.option("--composed", is_flag=True, help="all nodes in one process, on a thread each")
def command(
    bag: Path, output: Path, rate: float, mode: str | None, mapper: str, odometry: str, imu: str | None,
    config: Path | None, topics: tuple[str, ...], calibrations: tuple[Path, ...], base_frame: str, overwrite: bool,
    old_map: Path | None, localize_only: bool, composed: bool, view: bool,
) -> None:  # fmt: skip
    """Map BAG with the nodes of the workspace: starts them, plays the bag, and writes what ``slam run`` does."""
    names = BagNames(parse_topics(topics), base_frame, read_rig_calibration(calibrations), rig_cameras())
    with SensorBag(bag, names) as opened:
        mode = mode_for(opened, mode)
        frames = sum(opened.count(agent, "depth" if mode == "tof" else "left") for agent in opened.agents)
    overrides = overrides_for(bag, with_files(own_overrides(config), names.calibration.parameters))
    system = choose(system_config(overrides), mode, mapper, odometry, imu)
    start = StartMap.read(system, map_folder(old_map, localize_only=localize_only), localize_only=localize_only)
    if mode != "tof":
        require_stereo(bag, names)
    compile_kernels_once()
    port = _page(view)
    transcript, results = Transcript(VERSION), OutputFolder(output, "nodes", bag, overwrite=overwrite)
    with transcript, results, giving_up(results), results.staged(rescue=MAP) as folder:
        with Interrupt() as interrupt, progress_bar() as progress:
            task = progress.add_task(f"nodes mapping {bag.name}", total=frames)
            run = run_nodes(
                bag, system, folder, logs=results.logs, odometry=odometry != "none", composed=composed, rate=rate,
                names=names, overrides=overrides, view_port=port, start_map=start,
                on_progress=lambda done: progress.update(task, completed=done), stopped=lambda: interrupt.asked,
            )  # fmt: skip
        # What draws and writes is loaded now: the nodes have needed the processor.
        from slam_bringup.processes.recorded_run import collect
        from slam_viewer.report.output import write_results
        from slam_viewer.report.result_bag import complete_recording

        result, _ = collect(bag, system, run, mapper=mapper, odometry=odometry, names=names, start_map=start)
        require_map(result)
        complete_recording(run.recording, result)
        summary = write_results(folder, result, pictures=not run.stopped)
        transcript.write(folder / LOGS / LOG_NAME, summary_table(summary, output))
    show(summary_table(summary, output))
    end_run(summary, output, stopped=run.stopped)


def _page(view: bool) -> int:
    """The port of the page, told to the user; 0 where none is wanted."""
    if not view:
        return 0
    for wanted in (_PAGE_PORT, 0):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", wanted))
            except OSError:
                continue
            port = int(probe.getsockname()[1])
            break
    click.echo(f"the nodes at work, once they have started: http://localhost:{port}", err=True)
    return port
