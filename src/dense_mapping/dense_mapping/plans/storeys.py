# SPDX-License-Identifier: Apache-2.0
"""Storeys: which floor plan a place belongs to, and which one a rig is on while it climbs, descends or rides a lift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dense_mapping.plans.floor_plan import FloorPlan
from slam_core.geometry import FloatArray

_BELOW_FLOOR = 0.3
"""Places so far (m) below a floor may still be on it: floors have noise."""
_CLEARLY = 0.5
"""A rig has arrived on another storey once it is so high (m) above that floor, or so far below its own."""


def storey_number(plans: Sequence[FloorPlan], point: FloatArray) -> int | None:
    """Number, from the lowest, of the storey that a point (3,) of the map is on: the highest floor below it.

    The lowest one for a point below all floors; None without any plan.
    """
    heights = _heights(plans, point)
    above = [(height, i) for i, height in enumerate(heights) if height > -_BELOW_FLOOR]
    return min(above)[1] if above else (0 if plans else None)


class CurrentStorey:
    """Storey that one rig is on; it changes once the rig has clearly left its own.

    ``number``: from the lowest, None while there is no plan.
    """

    def __init__(self) -> None:
        self.number: int | None = None

    def update(self, plans: Sequence[FloorPlan], point: FloatArray) -> bool:
        """Take the rig's place (3,) in the map and the plans as they are now; returns whether the storey is another."""
        before, found = self.number, storey_number(plans, point)
        if found is None or before is None or before >= len(plans):
            self.number = found
            return found != before
        heights = _heights(plans, point)
        has_left = heights[before] < -_CLEARLY or (found != before and heights[found] > _CLEARLY)
        self.number = found if has_left else before
        return self.number != before


def _heights(plans: Sequence[FloorPlan], point: FloatArray) -> list[float]:
    return [float(plan.height_of(np.asarray(point)[None])[0]) for plan in plans]
