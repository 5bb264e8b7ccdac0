"""Which nodes a run needs, with which parameters, and who has to keep up with which topic."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from slam_bringup.configuration import SystemConfig
from slam_bringup.node_arguments import ros_arguments
from slam_bringup.processes import NodeCommand
from slam_bringup.sensor_bag import AgentSensors
from slam_core.config import Config, iterate_parameters

RESULT_TOPICS = (
    "odom", "pose", "features", "landmarks", "ndt/odometry", "ndt/motion", "map_to_odom", "submap/landmarks",
    "submap/info",    "submap/path", "map/landmarks", "map/path", "map/graph", "map/ellipsoids", "map/cloud", "map/marks",
)  # fmt: skip
"""What ``slam nodes`` records, below each agent's namespace and at the root."""


@dataclass(frozen=True)
class NodeGraph:
    """Nodes in the order of their start, and what the bag player must know of them."""

    commands: tuple[NodeCommand, ...]
    played_topics: tuple[str, ...]
    pace: tuple[str, ...]
    recorded_topics: tuple[str, ...]
    filters: tuple[str, ...] = field(default=())
    """Full names of the ekf_slam nodes, one per agent."""
    finishers: tuple[str, ...] = field(default=())
    """Full names of the nodes that are told that the input has ended, in this order."""


def plan_nodes(config: SystemConfig, sensors: Mapping[str, AgentSensors], odometry: bool, map_path: str) -> NodeGraph:
    """The nodes of a run over the agents of a bag."""
    mode = config.feature_extractor.mode
    commands: list[NodeCommand] = []
    played: list[str] = []
    pace: list[str] = []
    for agent, sensor in sensors.items():
        nodes, topics = _agent_nodes(config, sensor, mode, odometry)
        commands += nodes
        played += topics
        pace += _pace(agent, sensor, mode, odometry)
    agents = tuple(sensors)
    commands.append(_command("sjsam_node", "sjsam", config.sjsam, "", {"agents": agents, "map_path": map_path}))
    recorded = {_join(agent, topic) for agent in ("", *agents) for topic in RESULT_TOPICS} | {"/diagnostics"}
    extractors = tuple(c.full_name for c in commands if c.executable == "feature_extractor")
    filters = tuple(c.full_name for c in commands if c.executable == "ekf_slam")
    return NodeGraph(
        tuple(commands), tuple(played), tuple(pace), (*sorted(recorded), "/static_transforms"), filters,
        (*extractors, *filters),
    )  # fmt: skip


def _agent_nodes(
    config: SystemConfig, sensor: AgentSensors, mode: str, odometry: bool
) -> tuple[list[NodeCommand], list[str]]:
    agent, commands, topics = sensor.agent, [], list[str]()
    if mode != "tof":
        compressed = sensor.topics["left"].endswith("/compressed")
        commands.append(_command("stereo_frontend", "stereo_driver", None, agent, {"compressed": compressed}))
        topics += [sensor.topics["left"], sensor.topics["right"]]
        topics += [_join(agent, f"stereo/{side}/camera_info") for side in ("left", "right")]
    if mode != "stereo" or odometry:
        commands.append(_command("tof_driver", "tof_driver", config.tof_driver, agent, {}))
        topics += [sensor.topics[role] for role in ("depth", "amplitude", "intensity") if role in sensor.topics]
        topics.append(_join(agent, "tof/camera_info"))
    if odometry:
        commands.append(_command("ndt_registration", "ndt_odometry", config.ndt_odometry, agent, {}))
    if "imu" in sensor.topics:
        topics.append(sensor.topics["imu"])
    commands.append(_command("stereo_frontend", "feature_extractor", config.feature_extractor, agent, {}))
    commands.append(_command("ekf_slam_node", "ekf_slam", config.ekf_slam, agent, {"agent": agent}))
    return commands, topics


def _pace(agent: str, sensor: AgentSensors, mode: str, odometry: bool) -> Iterable[str]:
    """The filter is last in line of the images; scan odometry and depth have their own line."""
    if mode != "tof":
        yield f"{_join(agent, 'ekf_slam')}={sensor.topics['left']}"
    if mode == "tof":
        yield f"{_join(agent, 'ekf_slam')}={sensor.topics['depth']}"
    if odometry:
        yield f"{_join(agent, 'ndt_odometry')}={sensor.topics['depth']}"
    elif mode in ("replace", "fuse"):
        yield f"{_join(agent, 'tof_driver')}={sensor.topics['depth']}"


def _command(package: str, executable: str, config: Config | None, agent: str, extra: Mapping[str, Any]) -> NodeCommand:
    parameters = dict(_changed(config)) if config is not None else {}
    arguments = ros_arguments(parameters | {k: v for k, v in extra.items() if v not in ("", False)}, agent)
    return NodeCommand(package, executable, tuple(arguments), agent)


def _changed(config: Config) -> Iterable[tuple[str, Any]]:
    """Parameters that differ from their defaults."""
    defaults = {name: value for name, value, _ in iterate_parameters(type(config)())}
    return ((name, value) for name, value, _ in iterate_parameters(config) if value != defaults[name])


def _join(agent: str, name: str) -> str:
    return f"/{agent}/{name}" if agent else f"/{name}"
