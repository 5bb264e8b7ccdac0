# SPDX-License-Identifier: Apache-2.0
"""Names of submaps, (agent, session, index), as a DiagnosticArray: one status each."""

from __future__ import annotations

from collections.abc import Iterable

from slam_core.messages.base import Message, MessageTypes, header_message

SubmapKey = tuple[str, int, int]
"""Agent, session and index of a submap."""

_LARGEST = 2**32


def submap_keys_message(types: MessageTypes, stamp: int, keys: Iterable[SubmapKey]) -> Message:
    """Message that names submaps."""
    statuses = []
    for agent, session, index in sorted(keys):
        values = {"agent": agent, "session": str(session), "index": str(index)}
        entries = [types.KeyValue(key=key, value=value) for key, value in values.items()]
        statuses.append(types.DiagnosticStatus(name=f"{agent}/{session}/{index}", values=entries))
    return types.DiagnosticArray(header=header_message(types, stamp, ""), status=statuses)


def submap_keys_from_message(message: Message) -> set[SubmapKey]:
    """Inverse of :func:`submap_keys_message`; ``ValueError`` for a message that names none."""
    keys = set()
    for status in message.status:
        values = {entry.key: entry.value for entry in status.values}
        numbers = [values.get(name, "") for name in ("session", "index")]
        if "agent" not in values or not all(n.isdecimal() and int(n) < _LARGEST for n in numbers):
            raise ValueError(f"a submap is named by agent, session and index, got {values}")
        keys.add((values["agent"], int(numbers[0]), int(numbers[1])))
    return keys
