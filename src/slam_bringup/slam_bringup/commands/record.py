"""``slam record``: write ROS topics to a bag; the node ``recorder`` behind a friendlier command line."""

from __future__ import annotations

from pathlib import Path

import click

from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import become_node


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="the bag to write")
@click.option("--storage", type=click.Choice(["mcap", "sqlite3"]), default="mcap", show_default=True)
@click.argument("topics", nargs=-1)
def command(output: Path, storage: str, topics: tuple[str, ...]) -> None:
    """Record TOPICS (all by default) until Ctrl-C."""
    parameters = {"bag": str(output), "storage": storage, "topics": topics}
    become_node("slam_bringup", "recorder", ros_arguments(parameters))
