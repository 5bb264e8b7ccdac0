# SPDX-License-Identifier: Apache-2.0
"""A node around a stage in which frames wait for other sensors."""

from __future__ import annotations

from typing import Any

from slam_core.base_node import SlamNode
from slam_core.config import C


class StageNode(SlamNode[C]):
    """Tells the base how long frames wait, and goes on without what is overdue."""

    stage: Any
    """Has ``oldest_waiting_ns`` and ``give_up()``; each node knows its own by type."""

    def publish_ready(self) -> object:
        """Publish the results of all frames that need not wait."""
        raise NotImplementedError

    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another sensor."""
        oldest: int | None = self.stage.oldest_waiting_ns
        return oldest

    def on_overdue(self) -> None:
        """Go on without the sensor that frames wait for."""
        self.stage.give_up()
        self.publish_ready()
