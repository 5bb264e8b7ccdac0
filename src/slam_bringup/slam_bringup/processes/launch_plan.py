# SPDX-License-Identifier: Apache-2.0
"""Processes of ``slam.launch.py``, from the texts of its arguments: for a live rig, or to play a bag.

    arguments, YAML -> configuration -> nodes with their parameters, names of topics, a player

Free of ROS's launch, so that it can be tested without; the launch file only hands these on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.rig_cameras import RigCameras
from slam_bags.reading.rig_file import read_rig_cameras
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames, is_rectified, nodes_name, parse_topics
from slam_bringup.pipeline.configuration import ODOMETRIES, choose, overrides_for, system_config, with_files
from slam_bringup.pipeline.overrides import Overrides, overrides_of, parse_assignments, read_overrides
from slam_bringup.processes.node_graph import NodeGraph, NodeSpec, live_nodes, plan_nodes
from slam_core.messages import STATIC_TRANSFORMS_TOPIC
from stereo_frontend.frontend_config import MODES

AUTO = "auto"
_BOOLEANS = ("true", "false")


@dataclass(frozen=True)
class LaunchArgument:
    """One argument of the launch file."""

    name: str
    default: str
    description: str
    choices: tuple[str, ...] = ()


ARGUMENTS = (
    LaunchArgument("agents", "", "names of the agents, comma-separated; empty: one rig"),
    LaunchArgument("mode", AUTO, "where depth comes from; auto: stereo, or what the bag has", (AUTO, *MODES)),
    LaunchArgument("odometry", "none", "of ToF scans", ODOMETRIES),
    LaunchArgument("config", "", "YAML of parameters: groups named after the nodes, or ROS's form"),
    LaunchArgument("set", "", "parameters in one line: ekf_slam.submap.max_distance=1.5, tof_driver.pictures=both"),
    LaunchArgument("topics", "", "topics that are named otherwise: left=/cam/left/image_raw, right_info=/..."),
    LaunchArgument("odometry_topic", "", "odometry of wheels, legs or another estimator [odometry]"),
    LaunchArgument("position_topic", "", "positions of UWB or GNSS in a fixed frame [position]"),
    LaunchArgument("pressure_topic", "", "air pressure of a barometer [pressure]"),
    LaunchArgument("base_frame", "", "frame of the rig [base_link, below the agent's name]"),
    LaunchArgument("calibration", "", "folders of slam calibrate, comma-separated, instead of the drivers' infos"),
    LaunchArgument("rig", "", "rig.yaml: several cameras of one rig, by the topics of each"),
    LaunchArgument("rectified", "false", "the stereo images are rectified: image_rect", _BOOLEANS),
    LaunchArgument("compressed", "false", "the stereo images are compressed: image_raw/compressed", _BOOLEANS),
    LaunchArgument("pictures", AUTO, "ToF pictures beside depth: auto, none, amplitude, both"),
    LaunchArgument("measurement", AUTO, "what the ToF camera measures", (AUTO, "range", "depth")),
    LaunchArgument("map_path", "", "folder that save_map writes and load_map reads"),
    LaunchArgument("initial_map", "", "folder of the map to begin with, which is only read"),
    LaunchArgument("localize_only", "false", "locate the agents in the loaded map without changing it", _BOOLEANS),
    LaunchArgument("bag", "", "a bag to play; topics, frames and sensors are then the bag's"),
    LaunchArgument("rate", "1.0", "speed of the bag; 0: as fast as the nodes follow"),
    LaunchArgument("use_sim_time", "false", "take time from /clock", _BOOLEANS),
)


@dataclass(frozen=True)
class LaunchPlan:
    """Nodes to start, and (name of the nodes, name outside) of topics."""

    nodes: tuple[NodeSpec, ...]
    remappings: tuple[tuple[str, str], ...] = ()


def plan_launch(values: Mapping[str, str]) -> LaunchPlan:
    """The plan for the texts of :data:`ARGUMENTS` by name; one that is left out has its default.

    Raises
    ------
    ValueError
        If a parameter, topic or file is wrong; the message says which.
    """
    values = {argument.name: argument.default for argument in ARGUMENTS} | dict(values)
    overrides = _overrides(values)
    given = [part.strip() for part in values["topics"].split(",") if part.strip()]
    for role in ("odometry", "position", "pressure"):
        given += [f"{role}={values[f'{role}_topic']}"] if values[f"{role}_topic"] else []
    topics = parse_topics(given)
    folders = [Path(part.strip()).expanduser() for part in values["calibration"].split(",") if part.strip()]
    rig = read_rig_cameras(Path(values["rig"]).expanduser()) if values["rig"] else RigCameras()
    names = BagNames(topics, values["base_frame"], read_rig_calibration(folders), rig)
    overrides = with_files(overrides, names.calibration.parameters)
    plan = _for_bag(values, overrides, names) if values["bag"] else _for_rig(values, overrides, names)
    if values["use_sim_time"] != "true":
        return plan
    timed = (NodeSpec(s.package, s.executable, s.namespace, {**s.parameters, "use_sim_time": True}) for s in plan.nodes)
    return LaunchPlan(tuple(timed), plan.remappings)


def _overrides(values: Mapping[str, str]) -> Overrides:
    """Overrides of the file, then of the arguments with a name of their own, then of ``set``."""
    origin = values["config"] or "launch arguments"
    rules = read_overrides(Path(values["config"]).expanduser()).rules if values["config"] else ()
    own: dict[str, dict[str, Any]] = {"sjsam": {}}
    for name in ("map_path", "initial_map"):
        if values[name]:
            own["sjsam"][name] = str(Path(values[name]).expanduser())
    if values["localize_only"] == "true":
        own["sjsam"]["localize_only"] = True
    given = {node: p for node, p in own.items() if p}
    line = overrides_of(parse_assignments(values["set"]), "set").rules
    return Overrides(origin, (*rules, *overrides_of(given, origin).rules, *line))


def _for_rig(values: Mapping[str, str], overrides: Overrides, names: BagNames) -> LaunchPlan:
    agents = tuple(name.strip() for name in values["agents"].split(",")) if values["agents"] else ("",)
    if any(agents) and names.topics:
        raise ValueError("topics can be given for one rig; with several agents remap them in their drivers")
    mode = "stereo" if values["mode"] == AUTO else values["mode"]
    config = choose(system_config(overrides), mode, "sjsam", values["odometry"])
    if names.calibration.is_given and (len(agents) > 1 or values["rectified"] == "true"):
        raise ValueError("a calibration is that of one rig, and of its raw images")
    if names.rig.topics and (len(agents) > 1 or names.calibration.is_given):
        raise ValueError("a rig.yaml is that of one rig, whose cameras publish their own calibration")
    if names.rig.transforms:
        raise ValueError("transforms of a rig.yaml are for bags: have them published (static_transform_publisher)")
    drivers = names.calibration.driver_parameters()
    compressed = {"compressed": True} if values["compressed"] == "true" else {}
    chosen = {k: values[k] for k in ("pictures", "measurement") if values[k] != AUTO}
    pictures = values["pictures"] if values["pictures"] != AUTO else {"depth": "none"}.get(values["measurement"], "")
    images = {"none": "range", "intensity": "intensity"}.get(pictures, "")
    chooses = images != "" and config.feature_extractor.tof.images == "auto"
    specs = live_nodes(
        config,
        agents,
        odometry=values["odometry"] != "none",
        rectified=values["rectified"] == "true"
        or {name for name, own in names.rig.topics.items() if is_rectified(own.get("left", ""))},
        extra={
            "tof_driver": drivers["tof_driver"] | chosen,
            "feature_extractor": {"tof.images": images} if chooses else {},
            "stereo_driver": drivers["stereo_driver"] | compressed,
        }
        | {f"{name}/tof_driver": chosen | _measurement(roles) for name, roles in names.rig.topics.items()},
        base_frames=dict.fromkeys(agents, names.base_frame) if names.base_frame else None,
        cameras={"": {name: {_role(r) for r in own} for name, own in names.rig.topics.items()}},
        overrides=overrides,
    )
    remapped = [pair for name, own in names.rig.topics.items() for pair in _remapped(own, name)]
    return LaunchPlan(tuple(specs), (*_remapped(names.topics), *remapped))


def _role(role: str) -> str:
    return "depth" if role == "range" else role


def _measurement(roles: Mapping[str, str]) -> dict[str, str]:
    """Parameter of the driver of a depth camera among several cameras."""
    return {"measurement": "range" if "range" in roles else "depth"} if {"range", "depth"} & roles.keys() else {}


def _remapped(topics: Mapping[str, str], place: str = "") -> list[tuple[str, str]]:
    """Pairs of the nodes' names, in the namespace ``place``, and the rig's names of its topics."""
    found = []
    for role, topic in topics.items():
        measurement = role if role in ("range", "depth") else "range"
        own = nodes_name(place, _role(role), topic, measurement)
        found.append((own, topic))
    return found


def _for_bag(values: Mapping[str, str], overrides: Overrides, names: BagNames) -> LaunchPlan:
    path = Path(values["bag"]).expanduser().resolve()
    with SensorBag(path, names) as bag:
        has_stereo = any(bag.count(agent, "left") for agent in next(iter(bag.rigs.values())))
        overrides = overrides_for(path, overrides)
        mode = ("stereo" if has_stereo else "tof") if values["mode"] == AUTO else values["mode"]
        config = choose(system_config(overrides), mode, "sjsam", values["odometry"])
        map_path = values["map_path"] or "map"
        graph = plan_nodes(
            config,
            bag.sensors,
            values["odometry"] != "none",
            map_path,
            overrides,
            autosave=True,
            calibration=names.calibration,
            mountings=names.rig.transforms,
        )
    return LaunchPlan((*graph.specs, _player(path, graph, values)))


def _player(path: Path, graph: NodeGraph, values: Mapping[str, str]) -> NodeSpec:
    parameters = {
        "bag": str(path),
        "rate": float(yaml.safe_load(values["rate"])),
        "topics": tuple(graph.played),
        "pace": graph.pace,
        "rename": tuple(f"{topic}={name}" for topic, name in graph.played.items() if name != topic),
        "wait_for_subscribers": 0.0,
        "nodes": tuple(command.full_name for command in graph.commands),
        "subscribers": tuple(f"{name}=1" for name in (*graph.played.values(), STATIC_TRANSFORMS_TOPIC)),
        "transforms": graph.transforms,
    }
    parameters = {name: value for name, value in parameters.items() if value != ()}
    return NodeSpec("slam_bags", "bag_player", "", parameters)
