# SPDX-License-Identifier: Apache-2.0
"""``slam demo``: ``slam nodes`` on the demo bag, with both cameras and scan odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slam_bringup.commands import nodes

DEMO = Path(__file__).parents[1] / "demo"
"""``bags/demo`` of the sources, installed with the package."""
_DEFAULTS = {"output": "out/demo", "mode": "fuse", "odometry": "ndt", "composed": True}


def _demo(**options: Any) -> None:
    if not DEMO.is_dir():
        raise ValueError(f"{DEMO} is missing: install slam_bringup again from a whole clone")
    assert nodes.command.callback is not None
    nodes.command.callback(bag=DEMO, **options)


command = click.Command(
    "demo",
    callback=_demo,
    params=[parameter for parameter in nodes.command.params if parameter.name != "bag"],
    context_settings={"default_map": _DEFAULTS},
    help="Map the demo bag with the nodes, into out/demo; the options are those of 'slam nodes'.",
)
