# SPDX-License-Identifier: Apache-2.0
"""``slam play``: publish a bag's topics; the node ``bag_player`` behind a friendlier command line."""

from __future__ import annotations

from pathlib import Path

import click

from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import become_node
from slam_bringup.terminal.paths import UserPath


@click.command()
@click.argument("bag", type=UserPath())
@click.option("--rate", type=click.FloatRange(min=0.0), default=1.0, show_default=True, help="0: as fast as possible")
@click.option("--loop", is_flag=True, help="start again at the end")
@click.option("--clock", is_flag=True, help="publish /clock")
@click.option("--topics", multiple=True, metavar="TOPIC", help="play only this topic (may be repeated)")
def command(bag: Path, rate: float, loop: bool, clock: bool, topics: tuple[str, ...]) -> None:
    """Publish the topics of BAG over ROS."""
    parameters = {"bag": str(bag), "rate": rate, "loop": loop, "clock": clock, "topics": topics}
    become_node("slam_bags", "bag_player", ros_arguments(parameters))
