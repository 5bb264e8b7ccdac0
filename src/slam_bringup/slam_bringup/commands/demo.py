# SPDX-License-Identifier: Apache-2.0
"""``slam demo``: the demo bag mapped with both cameras and scan odometry, by the nodes or, without ROS, offline."""

from __future__ import annotations

from typing import Any

import click

from slam_bringup.commands import nodes, run
from slam_bringup.extras import has_ros, require_ros
from slam_bringup.processes.kernels import DEMO

_DEFAULTS = {"output": "out/demo", "mode": "fuse", "odometry": "ndt", "composed": True}
_OF_NODES_ALONE = ("rate", "view", "composed")


def _demo(**options: Any) -> None:
    if not DEMO.is_dir():
        raise ValueError(f"{DEMO} is missing: install slam_bringup again from a whole clone")
    command: click.Command = nodes.command
    given: dict[str, Any] = {"bag": DEMO}
    if not has_ros():
        if options["rate"] or options["view"]:
            require_ros("--rate and --view: the demo with nodes")
        click.echo("no ROS 2 here: the demo is mapped offline, as by slam run", err=True)
        command, given = run.command, {"bags": (DEMO,), "scheduler": None, "workers": None}
        options = {name: value for name, value in options.items() if name not in _OF_NODES_ALONE}
    assert command.callback is not None
    command.callback(**given, **options)


command = click.Command(
    "demo",
    callback=_demo,
    params=[parameter for parameter in nodes.command.params if parameter.name != "bag"],
    context_settings={"default_map": _DEFAULTS},
    help="Map the demo bag with the nodes (without ROS offline), into out/demo; the options are those of 'slam nodes'.",
)
