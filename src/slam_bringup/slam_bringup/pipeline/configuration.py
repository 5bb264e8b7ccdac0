"""The configuration of the whole chain: one group per node, so that one YAML file serves ``slam run`` and the nodes.

ekf_slam:
  ros__parameters:          # this level may be left out
    submap.max_distance: 1.5
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import yaml

from dense_mapping.dense_model import DenseConfig
from ekf_slam_node.stage import IMU, MOTION, FilterConfig
from ndt_registration.odometry import OdometryConfig
from sjsam_node.global_map import GlobalMapConfig
from slam_bringup.bags.readings import AgentSensors
from slam_core.config import Config, from_mapping, group
from stereo_frontend.frontend import FrontendConfig
from tof_driver.depth import DepthConfig

MODES = ("stereo", "tof", "replace", "fuse")
MAPPERS = ("ekf", "sjsam")
ODOMETRIES = ("none", "ndt", "icp")


@dataclass(frozen=True)
class SystemConfig(Config):
    """Configurations of all nodes, named after them."""

    tof_driver: DepthConfig = group(DepthConfig)
    feature_extractor: FrontendConfig = group(FrontendConfig)
    ndt_odometry: OdometryConfig = group(OdometryConfig)
    ekf_slam: FilterConfig = group(FilterConfig)
    sjsam: GlobalMapConfig = group(GlobalMapConfig)
    dense_mapper: DenseConfig = group(DenseConfig)


def load_system_config(path: Path | None) -> SystemConfig:
    """Defaults, overridden by a YAML file where one is given.

    Raises
    ------
    ValueError
        If the file is no mapping, names an unknown node or parameter, or holds a value out of range.
    """
    return SystemConfig() if path is None else from_mapping(SystemConfig, read_overrides(path))


def read_overrides(path: Path) -> dict[str, dict[str, Any]]:
    """Parameters by node, as they stand in a YAML file, without the level ``ros__parameters``."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    nodes = {f.name for f in fields(SystemConfig)}
    if not isinstance(content, Mapping) or not set(content) <= nodes:
        raise ValueError(f"{path} must hold one mapping per node ({', '.join(sorted(nodes))}), found {list(content)}")
    overrides = {}
    for node, values in content.items():
        values = values or {}
        if not isinstance(values, Mapping):
            raise ValueError(f"{path}: the parameters of {node} must be a mapping, found {values!r}")
        overrides[node] = dict(values.get("ros__parameters", values))
    return overrides


def choose(config: SystemConfig, mode: str, mapper: str, odometry: str, imu: str | None = None) -> SystemConfig:
    """Apply the choices of the command line: where depth comes from, submaps or one filter, scan odometry or none, and
    whether an IMU is used (None: as configured).
    """
    motion = config.ekf_slam.motion
    submap = config.ekf_slam.submap
    if mapper == "ekf":
        submap = replace(submap, max_distance=1e6, max_landmarks=10**9, max_frames=10**9)
    registration = config.ndt_odometry.registration
    if odometry != "none":
        registration = replace(registration, method={"ndt": "ndt", "icp": "icp_plane"}[odometry])
    return replace(
        config,
        feature_extractor=replace(config.feature_extractor, mode=mode),
        ekf_slam=replace(
            config.ekf_slam,
            submap=submap,
            motion=motion if imu is None else replace(motion, imu=imu),
            wait_for=() if odometry == "none" else (MOTION,),
        ),
        ndt_odometry=replace(config.ndt_odometry, registration=registration),
    )


def filter_config(config: FilterConfig, sensors: AgentSensors) -> FilterConfig:
    """The filter of an agent, whose frames wait for its IMU as well where it has one that is used.

    Raises
    ------
    ValueError
        If an IMU is asked for and the agent has none.
    """
    if config.motion.imu == "on" and "imu" not in sensors.topics:
        raise ValueError("an IMU is asked for (--imu on) and there is no topic imu: name it by --topic imu=/...")
    imu = (IMU,) if "imu" in sensors.topics and config.motion.imu != "off" else ()
    return replace(config, agent=sensors.agent, wait_for=(*config.wait_for, *imu))
