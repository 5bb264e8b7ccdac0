# SPDX-License-Identifier: Apache-2.0
"""The ``radio_link`` node: an agent's submaps and pose over a thin link to a command post, corrections back.

At the agent it reads ``submap/*`` and ``odom``; at the post it publishes them below each agent's name, as ``sjsam``
reads them, and sends ``sjsam``'s ``map_to_odom`` back. Key expressions: ``slam/<agent>/pose``,
``slam/<agent>/submap/<session>/<index>`` and ``slam/<agent>/backlog`` to the post, ``slam/<agent>/ack`` and
``slam/<agent>/correction`` from it; ``slam/<agent>/want`` from it asks for ``slam/<agent>/details/<session>/<index>``,
``slam/<agent>/look`` for pictures and dense key frames in pieces, ``slam/<agent>/piece``.
With role peer an agent has such a link to every other one, under ``slam/<agent>/to/<other>/...``, and publishes all
submaps, its own too, as a post would have them.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from slam_core.nodes.base_node import SlamNode
from slam_core.ros import run_node
from slam_core.storage.files import state_folder
from slam_radio.link_end import End
from slam_radio.link_ends import AgentEnd, PostEnd
from slam_radio.packing.symbol_code import coder_library
from slam_radio.peer_end import PeerEnd
from slam_radio.radio_config import RadioConfig
from slam_radio.zenoh_link import ZenohLink

_PUMP_PERIOD_S = 0.1
_STATE_PERIOD_S = 1.0
_ENDS: dict[str, type[End]] = {"agent": AgentEnd, "post": PostEnd, "peer": PeerEnd}


class RadioLinkNode(SlamNode[RadioConfig]):
    """One end of the link: ``role`` says which."""

    def __init__(self) -> None:
        super().__init__("radio_link", RadioConfig)
        config = self.config
        if not (config.connect or config.listen or config.scouting or config.zenoh_config):
            raise ValueError("say where the other end is: parameter 'connect' or 'listen', as tcp/192.168.1.10:7447")
        coder_library()  # refuses to start without it
        self.state_folder = state_folder(config.state_path, self.get_namespace())
        self.link = ZenohLink(
            config.connect, config.listen, user=config.user, password_file=config.password_file,
            users_file=config.users_file, config_file=config.zenoh_config, scouting=config.scouting,
        )  # fmt: skip
        self.end = _ENDS[config.role](self)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_PUMP_PERIOD_S, lambda: self.end.pump(time.monotonic()), clock=steady)
        self.create_timer(_STATE_PERIOD_S, self._show_state, clock=steady)

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Offer a std_srvs/Trigger service that says what was done."""

        def answer(_: Any, response: Any) -> Any:
            response.success, response.message = True, action()
            self.get_logger().info(f"{name}: {response.message}")
            return response

        self.create_service(Trigger, name, answer)

    def on_reset(self) -> None:
        """Forget what has come; what waits to go out stays."""
        self.end.reset()

    def on_new_session(self) -> None:
        """The link does not depend on stamps."""

    def on_close(self) -> None:
        """End the link; what waits is sent after the next start."""
        self.link.close()
        self.finish_work()
        self.end.close()

    def _show_state(self) -> None:
        link = self.end.state(time.monotonic())
        self.health.set(link.state, link.reason)
        self.health.show("backlog_bytes", link.backlog_bytes)
        self.health.show("backlog_s", f"{link.backlog_s:.1f}")
        self._report_change()


def main() -> None:
    """Entry point of ``ros2 run slam_radio radio_link``."""
    run_node(RadioLinkNode, small_packets=True)
