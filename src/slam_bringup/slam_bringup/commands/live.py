# SPDX-License-Identifier: Apache-2.0
"""``slam live``: all nodes of a rig in one process, on a live camera or on topics."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import click

from slam_bringup.extras import GET_ROS
from slam_bringup.pipeline.configuration import load_system_config
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.processes.launch_plan import plan_launch
from slam_bringup.processes.node_graph import NodeSpec, peer_nodes, radio_node
from slam_bringup.terminal.mapping_options import map_folder, rig_options, tag_parameters


@click.command()
@click.argument("camera", required=False)
@click.option("--topics", "by_topics", is_flag=True, help="the sensors publish topics; instead of CAMERA")
@click.option("--left-info", type=click.Path(exists=True, dir_okay=False), help="camera_info YAML of its left half")
@click.option("--right-info", type=click.Path(exists=True, dir_okay=False), help="camera_info YAML of its right half")
@click.option("--agents", default="", help="names of the agents, comma-separated [one rig]")
@click.option(
    "--post", multiple=True, help="address of a command post (slam post), as tcp/192.168.1.10:7447; several: all"
)
@click.option(
    "--peer", "peers", multiple=True, metavar="NAME[=ADDRESS]",
    help="another agent to exchange submaps with, as bert=tcp/192.168.1.12:7448; no address: searched by multicast",
)  # fmt: skip
@click.option("--peer-listen", multiple=True, default=("tcp/0.0.0.0:7448",), show_default=True,
              help="address at which others reach this agent; several: all")  # fmt: skip
@rig_options
def command(
    camera: str | None, by_topics: bool, left_info: str | None, right_info: str | None, agents: str, mode: str | None,
    odometry: str, config: Path | None, topics: tuple[str, ...], calibrations: tuple[Path, ...], base_frame: str,
    old_map: Path | None, localize_only: bool, post: tuple[str, ...],
    peers: tuple[str, ...], peer_listen: tuple[str, ...],
) -> None:  # fmt: skip
    """Map live, until Ctrl-C: CAMERA is a side-by-side stereo camera (number or device), or --topics are there.

    The map is saved by the service ~/save_map of sjsam, as with separate nodes. With --map it goes on in the map of a
    finished run, with --localize-only the rig is only located in it. With --post and the rig's name (--agents) its
    submaps and poses go to a command post too, with --peer to other agents, and theirs come: what all have together is
    one map, that of /NAME/peers/sjsam, whether there is a post or not.
    """
    by_topics = by_topics or any(not topic.startswith(("odometry=", "position=", "pressure=")) for topic in topics)
    if by_topics == (camera is not None):
        raise ValueError("say what to map: a CAMERA, or --topics of the sensors' drivers")
    given = {
        "agents": agents, "mode": mode, "odometry": odometry, "config": config, "topics": ",".join(topics),
        "base_frame": base_frame, "calibration": ",".join(map(str, calibrations)),
        "initial_map": map_folder(old_map, localize_only=localize_only),
        "localize_only": "true" if localize_only else None,
        "set": "; ".join(f"{node}.{k}={v}" for node, own in tag_parameters().items() for k, v in own.items()),
    }  # fmt: skip
    plan = plan_launch({name: str(value) for name, value in given.items() if value})
    nodes = plan.nodes
    if camera is not None:
        nodes = tuple(_with_camera(spec, camera, left_info, right_info) for spec in nodes)
    if post:
        nodes = (*nodes, radio_node(_only(agents), post, base_frame))
    if peers:
        given_config = load_system_config(config)
        nodes = (*nodes, *peer_nodes(_only(agents), _addresses(peers), peer_listen, given_config))
    compile_kernels_once()
    remapped = [word for inner, outer in plan.remappings for word in ("-r", f"{inner}:={outer}")]
    run_in_one_process(nodes, ["--ros-args", *remapped])


def run_in_one_process(nodes: Iterable[NodeSpec], ros_arguments: Sequence[str] = ()) -> None:
    """Run nodes until Ctrl-C; ValueError where there is no ROS."""
    try:
        composed = importlib.import_module("slam_bringup.processes.composed_node")
    except ImportError as error:
        raise ValueError(f"live mapping needs ROS 2 Jazzy ({error}): {GET_ROS}") from error
    composed.run_composed([spec.command for spec in nodes], ros_arguments)


def _only(agents: str) -> str:
    """The agent that a command post and other agents know this rig by."""
    if not agents or "," in agents:
        raise ValueError("--post and --peer need the rig's name, one, as the others list it: --agents NAME")
    return agents.strip()


def _addresses(peers: Iterable[str]) -> dict[str, str]:
    """Name and address, or "", of each peer."""
    found: dict[str, str] = {}
    for text in peers:
        name, _, address = (part.strip() for part in text.partition("="))
        if not name or name in found or ("=" in text and not address):
            raise ValueError(f"--peer takes NAME or NAME=ADDRESS, each name once, got {text}")
        found[name] = address
    return found


def _with_camera(spec: NodeSpec, camera: str, left_info: str | None, right_info: str | None) -> NodeSpec:
    """The node with the parameters of a camera, if it is the driver."""
    if spec.executable != "stereo_driver":
        return spec
    given = {name: path for name, path in (("left_info", left_info), ("right_info", right_info)) if path}
    parameters = spec.parameters | given
    if not parameters.keys() >= {"left_info", "right_info"}:
        raise ValueError("a camera needs --calibration FOLDER, as slam calibrate stereo makes it")
    return replace(spec, parameters=parameters | {"source": "camera", "path": camera})
