# SPDX-License-Identifier: Apache-2.0
"""``slam post``: a command post, which joins what agents send over a radio link."""

from __future__ import annotations

from pathlib import Path

import click

from slam_bringup.commands.live import run_in_one_process
from slam_bringup.pipeline.configuration import load_system_config
from slam_bringup.processes.node_graph import post_nodes


@click.command()
@click.option("--agents", required=True, help="names of the agents, comma-separated")
@click.option("--listen", "addresses", multiple=True, default=("tcp/0.0.0.0:7447",), show_default=True,
              help="address to listen at; several: all")  # fmt: skip
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="of the page")
@click.option("--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="YAML of overrides")
def command(agents: str, addresses: tuple[str, ...], port: int, config: Path | None) -> None:
    """Run a command post until Ctrl-C: the agents' submaps come over Zenoh and become one map, shown on a page.

    At each agent: slam live ... --agents NAME --post tcp/ADDRESS:7447. The map is saved by ~/save_map of sjsam.
    """
    names = [name.strip() for name in agents.split(",")]
    nodes = post_nodes(names, addresses, port, load_system_config(config))
    run_in_one_process(nodes)
