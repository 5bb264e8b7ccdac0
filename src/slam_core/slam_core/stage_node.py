# SPDX-License-Identifier: Apache-2.0
"""A node around a stage in which frames wait for other sensors."""

from __future__ import annotations

from typing import Protocol

from slam_core.base_node import SlamNode
from slam_core.config import C


class WaitingStage(Protocol):
    """Interface of the stage."""

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another sensor."""

    def give_up(self) -> None:
        """Go on without what frames wait for."""


class StageNode(SlamNode[C]):
    """Tells the base how long frames wait, and goes on without what is overdue."""

    stage: WaitingStage

    def publish_ready(self) -> object:
        """Publish the results of all frames that need not wait."""
        raise NotImplementedError

    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another sensor."""
        return self.stage.oldest_waiting_ns

    def on_overdue(self) -> None:
        """Go on without the sensor that frames wait for."""
        self.stage.give_up()
        self.publish_ready()
