# SPDX-License-Identifier: Apache-2.0
"""``slam record``: write ROS topics to a bag; the node ``recorder`` behind a friendlier command line."""

from __future__ import annotations

from pathlib import Path

import click

from slam_bags.storage.bag_owner import require_free
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import become_node
from slam_bringup.terminal.paths import UserPath, overwrite_option


@click.command()
@click.option("-o", "--output", type=UserPath(), required=True, help="the bag to write")
@click.option("--storage", type=click.Choice(["mcap", "sqlite3"]), default="mcap", show_default=True)
@overwrite_option("a bag that slam recorded or wrote")
@click.argument("topics", nargs=-1)
def command(output: Path, storage: str, overwrite: bool, topics: tuple[str, ...]) -> None:
    """Record TOPICS (all by default) until Ctrl-C."""
    require_free(output, overwrite=overwrite)
    parameters = {"bag": str(output), "storage": storage, "topics": topics, "overwrite": overwrite}
    become_node("slam_bags", "recorder", ros_arguments(parameters))
