# SPDX-License-Identifier: Apache-2.0
"""The parameters of the ``radio_link`` node."""

from __future__ import annotations

import re
from dataclasses import dataclass

from slam_core.config import Config, group, parameter
from slam_radio.packing.light_submap import LightConfig
from slam_radio.views.view_config import ViewConfig

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class RadioConfig(Config):
    """One end of the link between agents and a command post."""

    role: str = parameter("agent", "end of the link; peer: an agent among others", choices=("agent", "post", "peer"))
    agents: tuple[str, ...] = parameter(
        ("agent",),
        "names of the agents on the link; with role agent one name, its own: the post knows it by that; "
        "with role peer its own first",
    )
    connect: tuple[str, ...] = parameter((), "addresses to connect to, as tcp/192.168.1.10:7447")
    listen: tuple[str, ...] = parameter((), "addresses to listen at, as tcp/0.0.0.0:7447")
    bytes_per_second: float = parameter(20000.0, "budget of what goes out, headers included", unit="B/s", minimum=300.0)
    light: LightConfig = group(LightConfig)
    resend_after_s: float = parameter(
        5.0, "a submap without acknowledgement goes out again after this time, then after twice that, and so on",
        unit="s", minimum=0.5,
    )  # fmt: skip
    silent_after_s: float = parameter(10.0, "the other end counts as silent after this time", unit="s", minimum=3.0)
    whole_megabytes: float = parameter(
        500.0, "whole submaps that an agent keeps on disk for who asks for details, a post or a peer; of older ones it "
        "keeps the details packed, a thousandth of that", unit="MB", minimum=0.0,
    )  # fmt: skip
    views: ViewConfig = group(ViewConfig)
    state_path: str = parameter(
        "radio", "folder of what waits and of what has come; a relative one below the user's state and the namespace"
    )
    correction_topic: str = parameter(
        "map_to_odom", "topic at the agent of the post's map_to_odom; empty: it is not published"
    )
    source: str = parameter("", "with role peer: namespace of the agent's own topics, by default the node's")
    broadcast_tf: bool = parameter(True, "publish the correction at the agent on /tf too, unless sjsam runs there")
    map_frame: str = parameter("map", "frame of the post's map")
    odom_frame: str = parameter("odom", "frame of an agent's odometry; at the post below its name")
    base_frame: str = parameter("base_link", "frame of an agent's rig; at the post below its name")
    user: str = parameter("", "user name towards a Zenoh that asks for one")
    password_file: str = parameter("", "file that holds the password of user")
    users_file: str = parameter("", "file of lines user:password that may connect here")
    zenoh_config: str = parameter("", "Zenoh configuration file (JSON5) to begin with, for TLS and the like")
    scouting: bool = parameter(False, "find other ends by multicast too")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.agents or any(not _NAME.fullmatch(agent) for agent in self.agents):
            raise ValueError(f"parameter 'agents' must name the agents by letters, digits and _, got {self.agents}")
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"parameter 'agents' names an agent twice: {', '.join(self.agents)}")
        if self.role == "agent" and len(self.agents) != 1:
            raise ValueError(f"an agent has one name, parameter 'agents' has {len(self.agents)}")
        if self.role == "peer" and len(self.agents) < 2:
            raise ValueError(f"a peer needs others: parameter 'agents' has {len(self.agents)}")
        if self.user and not self.password_file:
            raise ValueError("parameter 'user' needs 'password_file'")
