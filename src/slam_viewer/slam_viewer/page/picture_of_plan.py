# SPDX-License-Identifier: Apache-2.0
"""A floor plan as a picture with transparency: it lies over the model without hiding it."""

from __future__ import annotations

import numpy as np

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, FloorPlan
from slam_core.types import ByteArray

_RGBA = {FREE: (235, 245, 235, 150), OCCUPIED: (40, 40, 60, 255)}


def plan_picture(plan: FloorPlan) -> ByteArray:
    """RGBA (rows, columns, 4) uint8, the highest y first; what is unknown is not drawn."""
    picture = np.zeros((*plan.cells.shape, 4), dtype=np.uint8)
    for value, colour in _RGBA.items():
        picture[plan.cells == value] = colour
    return np.ascontiguousarray(picture[::-1])
