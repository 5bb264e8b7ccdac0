# SPDX-License-Identifier: Apache-2.0
"""A node around a stage in which frames wait for other sensors."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined"

from __future__ import annotations

import time
from typing import Any

from rclpy.clock import Clock, ClockType

from slam_core.config import C
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.input_config import OVERDUE_S
from slam_core.nodes.job_queue import QueuedCall
from slam_core.nodes.listening_node import Input
from slam_core.nodes.stamp_guard import StampPolicy


class StageNode(SlamNode[C]):
    """Goes on without what is overdue: frames of a live node wait for another sensor no longer than ``OVERDUE_S``.

    This is the clock's part in patience; the stage itself counts frames, which may have ended as well.
    """

    stage: Any
    """Has ``oldest_waiting_ns`` and ``give_up()``; each node knows its own by type."""

    def __init__(self, name: str, config_type: type[C]) -> None:
        super().__init__(name, config_type)
        self._waiting: tuple[int | None, float] = (None, 0.0)
        if self.input_config.policy == "newest":
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self.create_timer(0.25 * OVERDUE_S, self._look_for_overdue, clock=steady)

    def publish_ready(self) -> object:
        """Publish the results of all frames that need not wait."""
        raise NotImplementedError

    def _can_wait(self, entry: Input) -> bool:
        """Readings of an IMU, say, while no frame waits for one: each of them would wake the node."""
        accompanies = entry.policy is StampPolicy.FOLLOWS and self.stage.oldest_waiting_ns is None
        return accompanies or super()._can_wait(entry)

    def _look_for_overdue(self) -> None:
        waiting, now = self.stage.oldest_waiting_ns, time.monotonic()
        if waiting is None or waiting != self._waiting[0]:
            self._waiting = (waiting, now)
        elif now - self._waiting[1] > OVERDUE_S:
            self._jobs.add(QueuedCall("overdue", self._go_on_without))

    def _go_on_without(self) -> None:
        self.stage.give_up()
        self.publish_ready()
