# SPDX-License-Identifier: Apache-2.0
"""Compares records of the map as tasks, of which several run at once on other processes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np

from sjsam_node.loop_closure.association import PointSet
from sjsam_node.loop_closure.detector import Found, RecordPair, compared
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.loop_closure.verification import ClosureConfig, Verifier
from sjsam_node.regions.tasks import Tasks
from sjsam_node.smoothing.estimate import MapEstimate

_HELD = 32
"""Records whose landmarks the workers keep, those that were compared last."""


def _compared(first: PointSet, second: PointSet, wanted: RecordPair, config: ClosureConfig) -> Found:
    return compared(Verifier(config), first, second, wanted)


class RecordComparisons:
    """Comparisons of records, as :attr:`LoopDetector.compare` asks for them: a task each.

    Parameters
    ----------
    estimate
        The map.
    config
        Of closures.
    tasks
        Where they run.
    """

    def __init__(self, estimate: MapEstimate, config: ClosureConfig, tasks: Tasks) -> None:
        self._estimate, self._config, self._tasks = estimate, config, tasks
        self._held: OrderedDict[int, Any] = OrderedDict()

    def __call__(self, wanted: Sequence[RecordPair]) -> list[Found]:
        """The findings of all comparisons, in their order."""
        found = list[Found]()
        for start in range(0, len(wanted), _HELD // 2):  # a few at once: what workers are sent takes time and memory
            handles = [
                self._tasks.submit(_compared, self._points(one.first), self._points(one.second), one, self._config)
                for one in wanted[start : start + _HELD // 2]
            ]
            found += self._tasks.gather(handles)
            while len(self._held) > _HELD:
                self._held.popitem(last=False)
        return found

    def _points(self, record: int) -> Any:
        """Handle of a record's landmarks, in memory: what the map keeps on disk is read once, and sent."""
        if record not in self._held:
            points = at_start(self._estimate.graph.records[record])
            self._held[record] = self._tasks.hold(
                PointSet(np.array(points.points), np.array(points.covariance), np.array(points.descriptors))
            )
        self._held.move_to_end(record)
        return self._held[record]
