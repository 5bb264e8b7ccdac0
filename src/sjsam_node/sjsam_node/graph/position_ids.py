# SPDX-License-Identifier: Apache-2.0
"""Landmark ids of an antenna's places: one for each stamp, far below those of other landmarks and of tags."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.linear_algebra.block_pattern import IntArray

_FIRST = -(2**62)
"""Of stamp zero: later stamps lie below, down to the year 2116."""


def position_ids(stamps_ns: IntArray) -> IntArray:
    """Ids (n,) of the places at which an antenna was at these stamps (n,)."""
    return np.asarray(_FIRST - np.asarray(stamps_ns, dtype=np.int64))


def position_stamps(ids: IntArray) -> IntArray:
    """Stamps (n,) of ids (n,) that :func:`position_ids` made."""
    return np.asarray(_FIRST - ids)


def is_position_id(ids: IntArray) -> npt.NDArray[np.bool_]:
    """Mask (n,) of the ids that are an antenna's."""
    return np.asarray(ids <= _FIRST)
