"""What ``slam run`` and ``slam nodes`` have in common: arguments, options, and the progress bar."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from slam_bringup.configuration import MAPPERS, MODES, ODOMETRIES
from slam_bringup.sensor_bag import SensorBag

_OPTIONS = (
    click.argument("bag", type=click.Path(exists=True, path_type=Path)),
    click.option(
        "-o", "--output", type=click.Path(file_okay=False, path_type=Path), required=True, help="folder to write"
    ),
    click.option("--mode", type=click.Choice(MODES), help="where depth comes from [stereo; tof without stereo]"),
    click.option(
        "--mapper", type=click.Choice(MAPPERS), default="sjsam", show_default=True, help="one filter, or submaps"
    ),
    click.option("--odometry", type=click.Choice(ODOMETRIES), default="none", show_default=True, help="of ToF scans"),
    click.option(
        "--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="YAML, one group per node"
    ),
)


def mapping_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument BAG and the options of mapping."""
    return reduce(lambda decorated, option: option(decorated), reversed(_OPTIONS), command)


def mode_for(bag: SensorBag, mode: str | None) -> str:
    """The mode asked for, or the one that the bag's sensors suggest."""
    return mode or ("stereo" if bag.count(bag.agents[0], "left") else "tof")


def progress_bar() -> Progress:
    """On standard error, so that standard output holds the result alone."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))
