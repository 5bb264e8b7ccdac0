# SPDX-License-Identifier: Apache-2.0
"""Zenoh between agents and post, as a sender and receiver of bytes under keys.

The package eclipse-zenoh is loaded where a link is opened, not before.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from slam_core.storage.files import read_text

ADVICE = "the radio link needs Zenoh, which is not installed: pip install eclipse-zenoh"

Receiver = Callable[[str, bytes], None]
"""Called with key and bytes on a thread of Zenoh's."""


class ZenohLink:
    """Peers that know each other by ``connect`` and ``listen`` alone, unless ``scouting`` is on.

    Connections that are lost are tried again for ever.

    Raises
    ------
    ValueError
        If Zenoh is not installed, or refuses the endpoints or the configuration.
    """

    def __init__(
        self, connect: Sequence[str], listen: Sequence[str], *, user: str = "", password_file: str = "",
        users_file: str = "", config_file: str = "", scouting: bool = False,
    ) -> None:  # fmt: skip
        try:
            import zenoh
        except ImportError as error:
            raise ValueError(ADVICE) from error
        self._zenoh: Any = zenoh
        try:
            config = zenoh.Config.from_file(config_file) if config_file else zenoh.Config()
            for path, value in _settings(connect, listen, user, password_file, users_file, scouting).items():
                config.insert_json5(path, json.dumps(value))
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            raise ValueError(
                f"the radio link does not open (connect {list(connect)}, listen {list(listen)}): {error}"
            ) from error
        self._subscribers: list[Any] = []

    def listen(self, key: str, receiver: Receiver) -> None:
        """Have messages under a key expression received."""

        def receive(sample: Any) -> None:
            receiver(str(sample.key_expr), sample.payload.to_bytes())

        self._subscribers.append(self._session.declare_subscriber(key, receive))

    def send(self, key: str, data: bytes, *, urgent: bool) -> None:
        """Send, or drop where the link is full; ``urgent`` messages overtake others."""
        priority = self._zenoh.Priority.INTERACTIVE_HIGH if urgent else self._zenoh.Priority.DATA_LOW
        self._session.put(
            key, data, priority=priority, congestion_control=self._zenoh.CongestionControl.DROP, express=urgent
        )

    def close(self) -> None:
        """End the session."""
        self._session.close()


def _settings(
    connect: Sequence[str], listen: Sequence[str], user: str, password_file: str, users_file: str, scouting: bool
) -> dict[str, Any]:
    """Zenoh's own names and values."""
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": scouting,
        "scouting/gossip/enabled": scouting,
        "transport/shared_memory/enabled": False,  # segments that outlive a killed process
        "connect/timeout_ms": -1,  # for ever, in the background
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 1000, "period_max_ms": 4000, "period_increase_factor": 2},
    }
    if connect:
        settings["connect/endpoints"] = list(connect)
    if user:
        password = read_text(Path(password_file).expanduser(), 1000).strip()
        settings["transport/auth/usrpwd/user"] = user
        settings["transport/auth/usrpwd/password"] = password
    if users_file:
        settings["transport/auth/usrpwd/dictionary_file"] = str(Path(users_file).expanduser())
    return settings
