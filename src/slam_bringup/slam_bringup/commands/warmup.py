# SPDX-License-Identifier: Apache-2.0
"""``slam warmup``: compiles all kernels once, so that no first run and no node has to wait for it."""

from __future__ import annotations

from pathlib import Path

import click

from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.commands.console import progress_bar
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag


@click.command()
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
def command(bag: Path) -> None:
    """Map BAG, which should have stereo, ToF and a loop (bags/demo), for the sake of the compiler's cache alone."""
    with SensorBag(bag) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
    config = choose(load_system_config(None), "fuse", "sjsam", "ndt")
    with progress_bar() as progress:
        task = progress.add_task("compiling kernels", total=2 * readings)
        run_bag(bag, config, odometry="ndt", on_reading=lambda: progress.advance(task))
        progress.update(task, completed=2 * readings)
