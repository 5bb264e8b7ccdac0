# SPDX-License-Identifier: Apache-2.0
"""One agent's messages of a bag, judged by their stamps as the nodes judge them, then paired to readings.

    message -> StampGuard -> AgentPairing -> readings, SessionStart where the clock has jumped back for good

A second time that a bag holds, of two recordings joined for instance, is left out: each moment is mapped once.
"""

from __future__ import annotations

from slam_bags.reading.left_out import LeftOut
from slam_bags.reading.readings import AgentPairing, AgentSensors, Reading, SessionStart
from slam_core.messages import stamp_ns
from slam_core.messages.base import Message
from slam_core.nodes.stamp_guard import StampDecision, StampGuard
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S

_UNPAIRED = f"images without a partner within {1000 * PAIRING_TOLERANCE_S:g} ms of their stamp"
FOLLOWING = ("imu", "odometry", "position", "pressure", "mask", "tof_mask")
"""Roles that begin no session."""


class AgentStream:
    """Judges and pairs; what it drops is counted in ``left_out``."""

    def __init__(self, sensors: AgentSensors, left_out: LeftOut) -> None:
        self._sensors = sensors
        self._left_out = left_out
        self._guard = StampGuard[Message]()
        self._pairing = AgentPairing(sensors, left_out)
        self._span: tuple[int, int] | None = None
        self._earlier: list[tuple[int, int]] = []

    def add(self, role: str, message: Message) -> list[Reading]:
        """The readings that this message leads to."""
        starts = role not in FOLLOWING
        return self._take(role, self._guard.add(role, stamp_ns(message), message, starts_sessions=starts))

    def finish(self) -> list[Reading]:
        """The readings of what was held when the bag ended; the images that never found their partner are counted."""
        readings = [r for role, decision in self._guard.finish() for r in self._take(role, decision)]
        self._pairing.flush()
        if self._pairing.unpaired:
            self._left_out.add(_UNPAIRED, self._pairing.unpaired)
        return readings

    def _take(self, role: str, decision: StampDecision[Message]) -> list[Reading]:
        topic = self._sensors.topics[role]
        if decision.fault is not None:
            warning = f"{topic}: messages left out, the first because {decision.reason}"
            self._left_out.add(f"{decision.fault.value} on {topic}", len(decision.rejected), warning)
        readings: list[Reading] = []
        if decision.new_session:
            self._left_out.warn(f"{topic}: {decision.reason}: a new session begins")
            self._pairing.flush()
            self._earlier += [self._span] if self._span else []
            self._span = None
            readings.append(SessionStart(self._sensors.agent, decision.released[0][0]))
        for _, message in decision.released:
            readings += [r for r in self._pairing.add(role, message) if self._is_new(r, topic)]
        return readings

    def _is_new(self, reading: Reading, topic: str) -> bool:
        """True if no session before has had this moment."""
        stamp = reading.stamp_ns
        if any(first <= stamp <= last for first, last in self._earlier):
            self._left_out.add(f"messages on {topic} of a time that was recorded before")
            return False
        first, last = self._span or (stamp, stamp)
        self._span = min(first, stamp), max(last, stamp)
        return True
