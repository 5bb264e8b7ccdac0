# SPDX-License-Identifier: Apache-2.0
"""Graph of the nodes that a run needs, with their parameters, and the topics that each has to keep up with."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from slam_bags.reading.extrinsics import StaticTransform
from slam_bags.reading.readings import AgentSensors
from slam_bags.reading.rig_calibration import RigCalibration
from slam_bags.reading.rig_cameras import RIG_ROLES
from slam_bags.reading.sensor_topics import is_rectified, join, nodes_name
from slam_bringup.pipeline.configuration import SystemConfig, awaited_streams
from slam_bringup.pipeline.node_table import NODES, RESULT_TOPICS, node_named
from slam_bringup.pipeline.overrides import Overrides, is_parameter_of
from slam_bringup.pipeline.sensor_pipeline import for_camera, mode_of_camera, of_several, with_masks
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import NodeCommand
from slam_bringup.processes.start_map import StartMap
from slam_core.config import Config, iterate_parameters
from slam_core.messages import STATIC_TRANSFORMS_TOPIC

_REPLAY = {"input.policy": "all"}
"""The player waits for the nodes: they need not leave anything out."""


_MISSING = object()
_OF_A_CAMERA = ("stereo_driver", "tof_driver", "feature_extractor")
"""Nodes that a rig with several cameras has once for each."""


@dataclass(frozen=True)
class NodeSpec:
    """One node: where it is, in which namespace, and its parameters that differ from their defaults."""

    package: str
    executable: str
    namespace: str
    parameters: dict[str, Any]

    @property
    def command(self) -> NodeCommand:
        """The node as a command line."""
        arguments = ros_arguments(self.parameters, self.namespace)
        return NodeCommand(self.package, self.executable, tuple(arguments), self.namespace)


@dataclass(frozen=True)
class NodeGraph:
    """Nodes in the order of their start, and what the bag player and the recorder must know of them.

    played: topics of the bag, and what the nodes call them. filters: full names of the ekf_slam nodes, one per agent.
    finishers: full names of the nodes that are told that the input has ended, in this order. transforms: static
    transforms that replace the bag's, as the player takes them.
    """

    specs: tuple[NodeSpec, ...]
    commands: tuple[NodeCommand, ...]
    played: dict[str, str]
    pace: tuple[str, ...]
    recorded_topics: tuple[str, ...]
    filters: tuple[str, ...]
    finishers: tuple[str, ...]
    transforms: tuple[str, ...] = ()


def live_nodes(
    config: SystemConfig,
    agents: Iterable[str],
    *,
    odometry: bool,
    rectified: bool | Collection[str] = False,
    extra: Mapping[str, Mapping[str, Any]] | None = None,
    base_frames: Mapping[str, str] | None = None,
    known_roles: Mapping[str, Collection[str]] | None = None,
    with_laser: Iterable[str] = (),
    cameras: Mapping[str, Mapping[str, Collection[str]]] | None = None,
    overrides: Overrides | None = None,
) -> list[NodeSpec]:
    """Nodes for rigs with the sensors that the mode of ``config`` needs.

    ``cameras``: of agents whose rigs have several, the roles of each by its name; drivers and front end run once for
    each, in its namespace below the agent's, and ``extra`` is theirs by ``<agent>/<camera>/<executable>``.

    ``rectified``: their stereo images are, or those in some namespaces. ``extra``: parameters by executable.
    ``base_frames``: frame of each agent's rig, by default ``base_link`` below the agent's name. ``known_roles``:
    sensors of each agent that are known to report, such as its IMU; another is used as well, once it does.
    ``with_laser``: agents whose scan odometry registers the scans of a laser. ``overrides``: what of them is not in
    ``config``.
    """
    base_frames, with_laser = base_frames or {}, set(with_laser)
    mode, extra, agents = config.feature_extractor.mode, extra or {}, tuple(agents)
    specs = []
    for agent in agents:
        base = {"base_frame": base_frames[agent]} if agent in base_frames else _below(agent, base_frame="base_link")
        several = (cameras or {}).get(agent, {})
        modes = {join(agent, name)[1:]: mode_of_camera(mode, roles) for name, roles in several.items()} or {agent: mode}
        with_depth = tuple(name for name, roles in several.items() if "depth" in roles)
        for place, own_mode in modes.items():
            has_scans = agent not in with_laser if not several else place.rpartition("/")[2] in with_depth
            is_raw = not rectified if isinstance(rectified, bool) else place not in rectified
            if own_mode != "tof" and is_raw:
                specs.append(_spec("stereo_driver", None, place, extra))
            if own_mode != "stereo" or (odometry and has_scans):
                specs.append(_spec("tof_driver", config.tof_driver, place, extra))
        if odometry:
            frames = base | _below(agent, odom_frame="odom") | {"cameras": with_depth}
            specs.append(_spec("ndt_odometry", config.ndt_odometry, agent, extra, **frames))
        for place, own_mode in modes.items():
            front_end = replace(config.feature_extractor, mode=own_mode)
            front_end = of_several(front_end) if several else front_end
            specs.append(_spec("feature_extractor", front_end, place, extra))
        wait_for = awaited_streams(config.ekf_slam, (known_roles or {}).get(agent, ()))
        own = base | {"agent": agent, "wait_for": wait_for, "cameras": tuple(several)}
        specs.append(_spec("ekf_slam", config.ekf_slam, agent, extra, **own))
    specs.append(_spec("sjsam", config.sjsam, "", extra, agents=agents if any(agents) else ()))
    return [_overridden(spec, config, overrides) for spec in specs] if overrides else specs


def plan_nodes(
    config: SystemConfig,
    sensors: Mapping[str, AgentSensors],
    odometry: bool,
    map_path: str,
    overrides: Overrides | None = None,
    *,
    autosave: bool = False,
    calibration: RigCalibration | None = None,
    start_map: StartMap | None = None,
    mountings: Sequence[StaticTransform] = (),
) -> NodeGraph:
    """The nodes of a run over the agents of a bag; ``autosave`` where nobody has the map saved at the end.

    ``calibration``: instead of the bag's. ``start_map``: what ``sjsam`` begins with instead of an empty map.
    ``mountings``: static transforms that the bag lacks.
    """
    calibration = calibration or RigCalibration()
    mode = config.feature_extractor.mode
    first = next(iter(sensors.values()))
    rigs = _rigs(sensors)
    firsts = {rig: own[0] for rig, own in rigs.items()}
    base_frames = {rig: sensor.base_frame for rig, sensor in firsts.items()}
    extra = _bag_parameters(config, first, map_path, autosave, calibration)
    for executable, parameters in (start_map.parameters if start_map else {}).items():
        extra[executable] = extra.get(executable, {}) | parameters
    for camera in (own for several in rigs.values() for own in several if own.camera):
        of_camera = _bag_parameters(for_camera(config, camera), camera, map_path, autosave, calibration)
        extra |= {f"{camera.agent}/{name}": of_camera[name] for name in _OF_A_CAMERA}
    specs = live_nodes(
        config, rigs, odometry=odometry,
        rectified={own.agent for own in sensors.values() if is_rectified(own.topics.get("left", ""))},
        extra=extra, base_frames=base_frames,
        overrides=overrides,
        known_roles={rig: own.topics for rig, own in firsts.items()},
        with_laser=[rig for rig, own in firsts.items() if own.scanner == "scan"],
        cameras={rig: {s.camera: s.topics for s in several} for rig, several in rigs.items() if several[0].camera},
    )  # fmt: skip
    specs = [replace(spec, parameters=spec.parameters | _REPLAY) for spec in specs]
    finishers = [declared.executable for declared in NODES if declared.holds_frames]
    names = {e: tuple(s.command.full_name for s in specs if s.executable == e) for e in finishers}
    recorded = {join(agent, topic) for agent in ("", *rigs, *sensors) for topic in RESULT_TOPICS}
    return NodeGraph(
        specs=tuple(specs),
        commands=tuple(spec.command for spec in specs),
        played={
            topic: name
            for own in sensors.values()
            for topic, name in _topics(own, _mode_of(own, mode), odometry, calibration.files).items()
        },
        pace=tuple(p for own in rigs.values() for p in _paces(own, mode, odometry)),
        recorded_topics=(*sorted(recorded), "/diagnostics", STATIC_TRANSFORMS_TOPIC),
        filters=names["ekf_slam"],
        finishers=tuple(name for executable in finishers for name in names[executable]),
        transforms=tuple(t.text for t in (*calibration.transforms(first.left_frame, first.tof_frame), *mountings)),
    )


def viewer_nodes(config: SystemConfig, sensors: Mapping[str, AgentSensors], port: int) -> list[NodeSpec]:
    """The dense model and the page that shows it, beside the nodes of :func:`plan_nodes`."""
    rigs = _rigs(sensors)
    agents = tuple(rigs) if any(rigs) else ()
    of_rigs = {rig: tuple(own.camera for own in several if own.camera) for rig, several in rigs.items()}
    names, *others = dict.fromkeys(of_rigs.values())
    if others:
        names = tuple(f"{rig}/{name}" for rig, own in of_rigs.items() for name in own)
    model = _spec("dense_mapper", config.dense_mapper, "", {}, agents=agents, cameras=names)
    page = _spec("viewer", None, "", {}, agents=agents, port=port)
    return [model, page]


def radio_node(agent: str, addresses: Sequence[str], base_frame: str = "") -> NodeSpec:
    """The link of an agent, which has a map of its own, to the command post at ``addresses``.

    ``base_frame``: of the rig, by default ``base_link`` below the agent's name.
    """
    parameters = {
        "agents": (agent,), "connect": tuple(addresses), "correction_topic": "post/map_to_odom", "broadcast_tf": False,
        "base_frame": base_frame or f"{agent}/base_link",
    }  # fmt: skip
    return NodeSpec("slam_radio", "radio_link", agent, parameters)


def peer_nodes(agent: str, peers: Mapping[str, str], listen: Sequence[str], config: SystemConfig) -> list[NodeSpec]:
    """The link of an agent to others without a post, and the map of all of them, in the namespace ``<agent>/peers``.

    ``peers``: address of each other agent by its name; those without one are searched by multicast. Frames are others
    than those of the agent's own map, so that both can be on ``/tf``.
    """
    namespace, names = f"{agent}/peers", (agent, *peers)
    addresses = tuple(address for address in peers.values() if address)
    link: dict[str, Any] = {
        "role": "peer", "agents": names, "source": f"/{agent}", "odom_frame": "peers_odom", "listen": tuple(listen)
    }  # fmt: skip
    if addresses:
        link["connect"] = addresses
    if len(addresses) < len(peers):
        link["scouting"] = True
    frames = {"map_frame": "peers_map", "odom_frame": "peers_odom"}
    joined = _spec("sjsam", config.sjsam, namespace, {}, agents=names)
    return [
        NodeSpec("slam_radio", "radio_link", namespace, link),
        NodeSpec(joined.package, joined.executable, namespace, joined.parameters | frames),
    ]


def post_nodes(agents: Sequence[str], addresses: Sequence[str], port: int, config: SystemConfig) -> list[NodeSpec]:
    """The nodes of a command post that listens at ``addresses``, with a page at ``port``."""
    link = {"role": "post", "agents": tuple(agents), "listen": tuple(addresses)}
    single = {"tsdf.min_images": 1}  # key frames that are asked for seldom overlap
    return [
        NodeSpec("slam_radio", "radio_link", "", link),
        _spec("sjsam", config.sjsam, "", {}, agents=tuple(agents)),
        _spec("dense_mapper", config.dense_mapper, "", {"dense_mapper": single}, agents=tuple(agents)),
        _spec("viewer", None, "", {}, agents=tuple(agents), port=port),
    ]


def _bag_parameters(
    config: SystemConfig, sensor: AgentSensors, map_path: str, autosave: bool, calibration: RigCalibration
) -> dict[str, dict[str, Any]]:
    """Parameters of the nodes that follow from a bag's topics."""
    pictures = [name for name in ("amplitude", "intensity") if name in sensor.topics]
    chosen = {0: "none", 2: "both"}.get(len(pictures)) or pictures[0]
    if chosen == "amplitude" and sensor.topics.get("color") == sensor.topics["amplitude"]:
        chosen = "color"
    chooses = config.feature_extractor.mode != "stereo" and config.feature_extractor.tof.images == "auto"
    compressed = sensor.topics.get("left", "").endswith("/compressed")
    drivers = calibration.driver_parameters()
    return {
        "stereo_driver": drivers["stereo_driver"] | ({"compressed": True} if compressed else {}),
        "tof_driver": drivers["tof_driver"] | {"measurement": sensor.measurement, "pictures": chosen},
        "feature_extractor": ({"tof.images": pictures[0] if pictures else "range"} if chooses else {})
        | ({"mask.use": "always"} if with_masks(config.feature_extractor, sensor).mask.use == "always" else {}),
        "sjsam": {"map_path": map_path} | ({} if autosave else {"autosave_period_s": 0.0}),
    }


def _topics(sensor: AgentSensors, mode: str, odometry: bool, calibrated: Collection[str]) -> dict[str, str]:
    """Topics to play by the nodes' names; the camera infos of cameras that are ``calibrated`` come from files."""
    roles = ["imu", "odometry", "position", "pressure"]
    if mode != "tof":
        roles += ["mask", "left", "right", "left_info", "right_info"]
    if odometry and sensor.scanner == "scan":
        roles += ["scan"]
    if mode != "stereo" or (odometry and sensor.scanner == "depth"):
        roles += ["depth", "amplitude", "intensity", "color", "tof_info", "tof_mask"]
    from_files = {f"{camera}_info" for camera in calibrated}
    roles = [role for role in roles if role not in from_files]
    return {sensor.topics[role]: _heard(sensor, role) for role in roles if role in sensor.topics}


def _heard(sensor: AgentSensors, role: str) -> str:
    place = sensor.rig if sensor.camera and role in RIG_ROLES else sensor.agent
    return nodes_name(place, role, sensor.topics[role], sensor.measurement)


def _rigs(sensors: Mapping[str, AgentSensors]) -> dict[str, list[AgentSensors]]:
    """Cameras of each rig, first one first, by the rig's namespace."""
    rigs: dict[str, list[AgentSensors]] = {}
    for own in sensors.values():
        rigs.setdefault(own.rig if own.camera else own.agent, []).append(own)
    return rigs


def _mode_of(sensor: AgentSensors, mode: str) -> str:
    return mode_of_camera(mode, sensor.topics) if sensor.camera else mode


def _paces(cameras: Sequence[AgentSensors], mode: str, odometry: bool) -> Iterable[str]:
    """Paces of one camera, or of the first of several, for which filter and scan odometry wait for the others."""
    first = cameras[0]
    if not first.camera:
        yield from _pace(first, mode, odometry)
        return
    image = "depth" if _mode_of(first, mode) == "tof" else "left"
    yield f"{join(first.rig, 'ekf_slam')}={_heard(first, image)}"
    with_depth = [camera for camera in cameras if camera.scanner]
    if odometry and with_depth:
        yield f"{join(first.rig, 'ndt_odometry')}={_heard(with_depth[0], with_depth[0].scanner)}"


def _pace(sensor: AgentSensors, mode: str, odometry: bool) -> Iterable[str]:
    """The filter is last in line of the images; scan odometry and depth have their own line."""
    agent = sensor.agent
    yield f"{join(agent, 'ekf_slam')}={_heard(sensor, 'depth' if mode == 'tof' else 'left')}"
    if odometry:
        yield f"{join(agent, 'ndt_odometry')}={_heard(sensor, sensor.scanner)}"
    elif mode in ("replace", "fuse"):
        yield f"{join(agent, 'tof_driver')}={_heard(sensor, 'depth')}"


def _spec(
    executable: str,
    config: Config | None,
    namespace: str,
    extra: Mapping[str, Mapping[str, Any]],
    **own: Any,
) -> NodeSpec:
    changed = dict(_changed(config)) if config is not None else {}
    of_place = extra.get(f"{namespace}/{executable}", extra.get(executable, {}))
    given = {name: value for name, value in own.items() if value is not False and value not in ("", ())}
    return NodeSpec(node_named(executable).package, executable, namespace, changed | given | dict(of_place))


def _below(agent: str, **frames: str) -> dict[str, str]:
    """Frames below an agent's name; those of a single rig keep the nodes' defaults."""
    return {parameter: f"{agent}/{frame}" for parameter, frame in frames.items()} if agent else {}


def _overridden(spec: NodeSpec, config: SystemConfig, overrides: Overrides) -> NodeSpec:
    """Parameters that only the node has, and those of one agent: the rest stands in ``config``, choices included."""
    node, everyone = spec.executable, overrides.of(f"/{spec.executable}")
    group = getattr(config, node, None)
    in_config = {name for name, _, _ in iterate_parameters(group)} if group is not None else set()
    own = overrides.of(spec.command.full_name)
    own = {n: v for n, v in own.items() if n not in in_config or everyone.get(n, _MISSING) != v}
    of_all = {n: v for n, v in overrides.of_all.items() if n not in in_config and is_parameter_of(node, n)}
    return NodeSpec(spec.package, node, spec.namespace, spec.parameters | of_all | own)


def _changed(config: Config) -> Iterable[tuple[str, Any]]:
    """Parameters that differ from their defaults."""
    defaults = {name: value for name, value, _ in iterate_parameters(type(config)())}
    return ((name, value) for name, value, _ in iterate_parameters(config) if value != defaults[name])
