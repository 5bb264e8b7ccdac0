"""``slam run``: the offline pipeline."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from slam_bringup.commands.mapping_options import mapping_options, mode_for, progress_bar
from slam_bringup.configuration import choose, load_system_config
from slam_bringup.output import write_results
from slam_bringup.pipeline import run_bag
from slam_bringup.result_bag import write_result_bag
from slam_bringup.sensor_bag import SensorBag
from slam_bringup.summary_table import summary_table


@click.command()
@mapping_options
def command(bag: Path, output: Path, mode: str | None, mapper: str, odometry: str, config: Path | None) -> None:
    """Map BAG without ROS: same classes as the nodes, no drops, the same bytes every time."""
    with SensorBag(bag) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
        mode = mode_for(opened, mode)
    system = choose(load_system_config(config), mode, mapper, odometry)
    with progress_bar() as progress:
        task = progress.add_task(f"mapping {bag.name}", total=readings)
        result, mapping = run_bag(
            bag, system, mapper=mapper, odometry=odometry, on_reading=lambda: progress.advance(task)
        )
    write_result_bag(output / "result.mcap", result)
    summary = write_results(output, result, mapping.global_map.save)
    Console().print(summary_table(summary, output))
