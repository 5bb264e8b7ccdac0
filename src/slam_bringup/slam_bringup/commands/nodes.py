"""``slam nodes``: the pipeline through the real ROS nodes."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from slam_bringup.configuration import MAPPERS, MODES, ODOMETRIES, choose, load_system_config
from slam_bringup.online_run import run_nodes
from slam_bringup.output import write_results
from slam_bringup.recorded_run import collect
from slam_bringup.sensor_bag import SensorBag
from slam_bringup.summary_table import summary_table


@click.command()
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True, help="folder to write")
@click.option("--rate", type=click.FloatRange(min=0.0), default=0.0, help="speed of the replay [as fast as it goes]")
@click.option("--mode", type=click.Choice(MODES), help="where depth comes from [stereo; tof without stereo]")
@click.option("--mapper", type=click.Choice(MAPPERS), default="sjsam", show_default=True, help="one filter, or submaps")
@click.option("--odometry", type=click.Choice(ODOMETRIES), default="none", show_default=True, help="of ToF scans")
@click.option("--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="YAML, one group per node")
def command(
    bag: Path, output: Path, rate: float, mode: str | None, mapper: str, odometry: str, config: Path | None
) -> None:
    """Map BAG with the nodes of the workspace: starts them, plays the bag, and writes what ``slam run`` does."""
    with SensorBag(bag) as opened:
        mode = mode or ("stereo" if opened.count(opened.agents[0], "left") else "tof")
        frames = sum(opened.count(agent, "depth" if mode == "tof" else "left") for agent in opened.agents)
    system = choose(load_system_config(config), mode, mapper, odometry)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(f"nodes mapping {bag.name}", total=frames)
        run = run_nodes(
            bag, system, output, odometry=odometry != "none", rate=rate,
            on_progress=lambda done: progress.update(task, completed=done),
        )  # fmt: skip
    result, _ = collect(bag, system, run, mapper=mapper, odometry=odometry)
    Console().print(summary_table(write_results(output, result), output))
