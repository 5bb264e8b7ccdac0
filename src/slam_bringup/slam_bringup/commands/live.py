# SPDX-License-Identifier: Apache-2.0
"""``slam live``: all nodes of a rig in one process, on a live camera or on topics."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path

import click

from slam_bringup.bags.rig_calibration import read_rig_calibration
from slam_bringup.commands.paths import calibration_option
from slam_bringup.pipeline.configuration import ODOMETRIES, choose, load_system_config
from slam_bringup.processes.node_graph import live_nodes
from stereo_frontend.frontend import MODES


@click.command()
@click.argument("camera", required=False)
@click.option("--topics", is_flag=True, help="the sensors publish topics; instead of CAMERA")
@click.option("--left-info", type=click.Path(exists=True, dir_okay=False), help="camera_info YAML of its left half")
@click.option("--right-info", type=click.Path(exists=True, dir_okay=False), help="camera_info YAML of its right half")
@calibration_option()
@click.option("--mode", type=click.Choice(MODES), default="stereo", show_default=True, help="where depth comes from")
@click.option(
    "--odometry",
    type=click.Choice(ODOMETRIES),
    default="none",
    show_default=True,
    help="scan odometry from the ToF camera",
)
@click.option("--agents", default="", help="names of the agents, comma-separated [one rig]")
@click.option(
    "--config",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="YAML, one group per node, as in docs/parameters.md",
)
def command(
    camera: str | None, topics: bool, left_info: str | None, right_info: str | None, calibrations: tuple[Path, ...],
    mode: str, odometry: str, agents: str, config: Path | None,
) -> None:  # fmt: skip
    """Map live, until Ctrl-C: CAMERA is a side-by-side stereo camera (number or device), or --topics are there.

    The map is saved by the service ~/save_map of sjsam, as with separate nodes.
    """
    if topics == (camera is not None):
        raise ValueError("say what to map: a CAMERA, or --topics of the sensors' drivers")
    calibration = read_rig_calibration(calibrations)
    system = choose(load_system_config(config, known=calibration.parameters), mode, "sjsam", odometry)
    names = [name.strip() for name in agents.split(",")]
    if calibration.is_given and len(names) > 1:
        raise ValueError(f"a calibration is that of one rig, and there are {len(names)} agents")
    extra = calibration.driver_parameters()
    if camera is not None:
        extra["stereo_driver"] |= _camera_parameters(camera, left_info, right_info, extra["stereo_driver"])
    specs = live_nodes(system, names, odometry=odometry != "none", extra=extra)
    try:
        composed = importlib.import_module("slam_bringup.processes.composed_node")
    except ImportError as error:
        raise ValueError(f"live mapping needs ROS 2 Jazzy ({error}): source an installation, or use ./slam") from error
    composed.run_composed([spec.command for spec in specs])


def _camera_parameters(
    camera: str, left_info: str | None, right_info: str | None, known: Mapping[str, str]
) -> dict[str, str]:
    given = {"left_info": left_info, "right_info": right_info}
    infos = {**known, **{name: path for name, path in given.items() if path}}
    if len(infos) < 2:
        raise ValueError("a camera needs --calibration FOLDER, as slam calibrate stereo makes it")
    return {"source": "camera", "path": camera, **infos}
