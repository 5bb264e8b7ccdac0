# SPDX-License-Identifier: Apache-2.0
"""The configuration of the whole chain: one group per node, so that one YAML file serves ``slam run`` and the nodes.

The form of the file: :mod:`slam_bringup.pipeline.overrides`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from dense_mapping.dense_model import DenseConfig
from ekf_slam_node.stage import IMU, MOTION, ODOMETRY, FilterConfig
from ndt_registration.odometry import OdometryConfig
from sjsam_node.global_map import GlobalMapConfig
from slam_bags.reading.readings import AgentSensors
from slam_bags.storage.bag_calibration import calibration_file
from slam_bringup.pipeline.node_table import NODES
from slam_bringup.pipeline.overrides import (
    Overrides,
    is_parameter_of,
    read_overrides,
    require_known_nodes,
    require_known_parameters,
)
from slam_core.config import Config, from_mapping, group, iterate_parameters
from slam_viewer.verdict import RunConfig
from stereo_frontend.frontend_config import FrontendConfig
from tof_driver.depth import DepthConfig

MAPPERS = ("ekf", "sjsam")
ODOMETRIES = ("none", "ndt", "icp")


@dataclass(frozen=True)
class SystemConfig(Config):
    """Configurations of all nodes, named after them, and ``run``: what a finished run is judged by."""

    tof_driver: DepthConfig = group(DepthConfig)
    feature_extractor: FrontendConfig = group(FrontendConfig)
    ndt_odometry: OdometryConfig = group(OdometryConfig)
    ekf_slam: FilterConfig = group(FilterConfig)
    sjsam: GlobalMapConfig = group(GlobalMapConfig)
    dense_mapper: DenseConfig = group(DenseConfig)
    run: RunConfig = group(RunConfig)


def load_system_config(path: Path | None, bag: Path | None = None, known: Iterable[Path] = ()) -> SystemConfig:
    """Defaults, overridden by what is known of a bag's calibration, then by a YAML file, where they are given.

    ``known``: files of parameters of a calibration that is used instead of the bag's. ValueError as
    :func:`system_config`.
    """
    own = Overrides() if path is None else read_overrides(path)
    return system_config(overrides_for(bag, with_files(own, known)))


def overrides_for(bag: Path | None, own: Overrides) -> Overrides:
    """A user's own overrides, after those of the file of a bag's calibration, if it has one."""
    file = None if bag is None else calibration_file(bag)
    return own if file is None or not file.is_file() else with_files(own, (file,))


def with_files(own: Overrides, files: Iterable[Path]) -> Overrides:
    """A user's own overrides, after those of files."""
    for file in files:
        known = read_overrides(file)
        own = Overrides(own.origin or known.origin, (*known.rules, *own.rules))
    return own


def system_config(overrides: Overrides) -> SystemConfig:
    """Defaults with the overrides of the algorithms; what only the nodes have, such as ``input.depth``, is left out.

    Raises
    ------
    ValueError
        With file, node and parameter, if a node or parameter is unknown or a value out of range.
    """
    groups = {f.name: getattr(SystemConfig(), f.name) for f in fields(SystemConfig)}
    nodes = {declared.executable for declared in NODES if not declared.is_tool}
    require_known_nodes(overrides, {*groups, *nodes})
    known = {name: {parameter for parameter, _, _ in iterate_parameters(config)} for name, config in groups.items()}
    for name in overrides.of_all:
        if not any(name in k for k in known.values()) and not any(is_parameter_of(n, name) for n in nodes):
            raise ValueError(f"{overrides.origin}: no node has a parameter '{name}'")
    for node in sorted(nodes - groups.keys()):
        require_known_parameters(overrides, node)
    parsed: dict[str, Any] = {name: _group(name, type(groups[name]), known[name], overrides) for name in groups}
    return SystemConfig(**parsed)


def _group(name: str, kind: type[Config], known: set[str], overrides: Overrides) -> Config:
    values = {n: v for n, v in overrides.of_all.items() if n in known}
    values |= {n: v for n, v in overrides.of(f"/{name}").items() if n in known or not is_parameter_of(name, n)}
    try:
        return from_mapping(kind, values)
    except ValueError as error:
        raise ValueError(f"{overrides.origin}: {name}: {error}") from error


def choose(config: SystemConfig, mode: str, mapper: str, odometry: str, imu: str | None = None) -> SystemConfig:
    """Apply the choices of the command line.

    Where depth comes from, submaps or one filter, scan odometry or none, and whether an IMU is used (None: as
    configured).
    """
    inertial = config.ekf_slam.imu
    submap = config.ekf_slam.submap
    if mapper == "ekf":
        submap = replace(submap, max_distance=1e6, max_landmarks=10**9, max_frames=10**9, drift=True)
    registration = config.ndt_odometry.registration
    if odometry != "none":
        registration = replace(registration, method=_method(odometry, registration.method))
    return replace(
        config,
        feature_extractor=replace(config.feature_extractor, mode=mode),
        ekf_slam=replace(
            config.ekf_slam,
            submap=submap,
            imu=inertial if imu is None else replace(inertial, use=imu),
            wait_for=() if odometry == "none" else (MOTION,),
        ),
        ndt_odometry=replace(config.ndt_odometry, registration=registration),
    )


def filter_config(config: FilterConfig, sensors: AgentSensors, *others: AgentSensors) -> FilterConfig:
    """The filter of an agent, whose frames wait for its IMU and odometry as well where it has some that are used.

    ``others``: the cameras of its rig beside the first.

    Raises
    ------
    ValueError
        If an IMU is asked for and the agent has none.
    """
    if config.imu.use == "on" and "imu" not in sensors.topics:
        raise ValueError("an IMU is asked for (--imu on) and there is no topic imu: name it by --topic imu=/...")
    cameras = tuple(own.camera for own in (sensors, *others)) if sensors.camera else ()
    agent = sensors.rig if sensors.camera else sensors.agent
    return replace(config, agent=agent, cameras=cameras, wait_for=awaited_streams(config, sensors.topics))


def awaited_streams(config: FilterConfig, roles: Collection[str]) -> tuple[str, ...]:
    """The streams that frames wait for from the start, with those of the sensors in ``roles`` that are used."""
    used = (IMU, "imu", config.imu.use), (ODOMETRY, "odometry", config.odometry.use)
    return (*config.wait_for, *(stream for stream, role, use in used if role in roles and use != "off"))


def _method(odometry: str, configured: str) -> str:
    """Registration method of a choice of the command line; ICP is point to plane unless configured otherwise."""
    if odometry == "ndt":
        return "ndt"
    return "icp" if configured == "icp" else "icp_plane"
