# SPDX-License-Identifier: Apache-2.0
"""``slam warmup``: compiles all kernels once, so that no first run and no node has to wait for it."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from ekf_slam_node.odometry.preintegration import ImuNoise, ImuReadings
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.kernel_signatures import called_kernels, compile_listed, read_signatures, write_signatures
from slam_bringup.terminal.console import progress_bar
from slam_core.types import ImuSample

_RUNS = (("fuse", "ndt"), ("stereo", "none"))
"""Modes and scan odometries that need all kernels between them; stereo alone tracks its features."""


@click.command()
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
@click.option("--write", is_flag=True, help="write the list of calls by which kernels are compiled, after mapping BAG.")
def command(bag: Path, write: bool) -> None:
    """Compile all kernels, on all processors; map BAG for that where the list of calls does not fit.

    BAG should have stereo, ToF and a loop (bags/demo).
    """
    with SensorBag(bag) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
    calls = {} if write else read_signatures()
    with progress_bar() as progress:
        task = progress.add_task("compiling kernels", total=len(calls) or None)
        if calls and compile_listed(lambda: progress.advance(task), calls):
            return
        progress.update(task, total=2 * len(_RUNS) * readings, completed=0)
        for number, (mode, odometry) in enumerate(_RUNS, 1):
            config = choose(load_system_config(None), mode, "sjsam", odometry)
            run_bag(bag, config, odometry=odometry, on_reading=lambda: progress.advance(task))
            progress.update(task, completed=2 * number * readings)
    _integrate_readings()
    if write:
        write_signatures(called_kernels())


def _integrate_readings() -> None:
    """Call the kernels of an IMU, which bags/demo does not have."""
    readings = ImuReadings()
    for stamp_ns in range(0, 40_000_000, 5_000_000):
        readings.add(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    readings.integrate(10_000_000, 30_000_000, np.zeros(6), ImuNoise(1e-3, 1e-2, 1.0, 10.0))
