"""``slam run``: the offline pipeline."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from slam_bringup.configuration import MAPPERS, MODES, ODOMETRIES, choose, load_system_config
from slam_bringup.output import write_results
from slam_bringup.pipeline import run_bag
from slam_bringup.result_bag import write_result_bag
from slam_bringup.sensor_bag import SensorBag
from slam_bringup.summary_table import summary_table


@click.command()
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True, help="folder to write")
@click.option(
    "--mode", type=click.Choice(MODES), default=None, help="where depth comes from [stereo; tof without stereo]"
)
@click.option("--mapper", type=click.Choice(MAPPERS), default="sjsam", show_default=True, help="one filter, or submaps")
@click.option("--odometry", type=click.Choice(ODOMETRIES), default="none", show_default=True, help="of ToF scans")
@click.option("--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="YAML, one group per node")
def command(bag: Path, output: Path, mode: str | None, mapper: str, odometry: str, config: Path | None) -> None:
    """Map BAG without ROS: same classes as the nodes, no drops, the same bytes every time."""
    with SensorBag(bag) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
        mode = mode or ("stereo" if opened.count(opened.agents[0], "left") else "tof")
    system = choose(load_system_config(config), mode, mapper, odometry)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(f"mapping {bag.name}", total=readings)
        result, mapping = run_bag(
            bag, system, mapper=mapper, odometry=odometry, on_reading=lambda: progress.advance(task)
        )
    write_result_bag(output / "result.mcap", result)
    summary = write_results(output, result, mapping.global_map.save)
    Console().print(summary_table(summary, output))
