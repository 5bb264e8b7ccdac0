# SPDX-License-Identifier: Apache-2.0
"""The parameters of the ``sjsam`` node."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sjsam_node.global_map import GlobalMapConfig
from slam_core.config import parameter
from slam_core.storage.files import state_folder


@dataclass(frozen=True)
class SjsamNodeConfig(GlobalMapConfig):
    """The map's parameters and the node's own."""

    agents: tuple[str, ...] = parameter(("",), "namespaces of the agents whose submaps are joined")
    map_frame: str = parameter("map", "frame of the map")
    odom_frame: str = parameter("odom", "frame of each agent's odometry, below its namespace")
    map_path: str = parameter("map", "folder that save_map writes and load_map reads")
    initial_map: str = parameter(
        "", "folder of the map to begin with, which is only read; empty: none, with localize_only that of map_path"
    )
    anchor_path: str = parameter(
        "",
        "anchor.yaml of slam anchor: its transform from map_frame to the building is sent on /tf_static; empty: none",
    )
    ply_path: str = parameter("map_landmarks.ply", "file that export_ply writes")
    localize_only: bool = parameter(False, "locate the agents in the loaded map without changing it")
    autosave_period_s: float = parameter(
        10.0, "time between two copies of the map that a killed node goes on from; 0: none", unit="s", minimum=0.0
    )
    autosave_path: str = parameter(
        "", "folder of that copy; empty: map_path with the ending .autosave, a relative one below the user's state"
    )
    scheduler: str = parameter(
        "",
        "address of the scheduler of a Dask cluster that compares submaps and joins old ones, tcp://HOST:8786; empty: "
        "this process does",
    )
    transform_tolerance_s: float = parameter(
        0.2, "how far ahead map_to_odom is stamped, so that a lookup at the present time works", unit="s", minimum=0.0
    )
    max_correction_speed: float = parameter(
        0.0, "largest speed at which map_to_odom, and the rig by it, is corrected; 0: at once", unit="m/s", minimum=0.0
    )
    max_correction_rate: float = parameter(
        0.0, "largest angular speed at which map_to_odom is corrected; 0: at once", unit="rad/s", minimum=0.0
    )


def copy_path(config: SjsamNodeConfig, namespace: str) -> Path:
    """Folder of the copy that a killed node goes on from."""
    return state_folder(config.autosave_path or f"{config.map_path}.autosave", namespace)
