# SPDX-License-Identifier: Apache-2.0
"""Readings that wait for the fixed frame, as arrays of a stored map; a map in which none wait has no such arrays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sjsam_node.graph.position_ids import is_position_id, position_stamps
from slam_core.types import AnyArray, PositionReading

_PREFIX = "waiting/"


def waiting_arrays(waiting: Mapping[int, tuple[PositionReading, ...]]) -> dict[str, AnyArray]:
    """Arrays of the readings that wait, by record."""
    if not waiting:
        return {}
    readings = [r for own in waiting.values() for r in own]
    return {
        f"{_PREFIX}records": np.repeat(np.array(list(waiting), np.int64), [len(own) for own in waiting.values()]),
        f"{_PREFIX}positions": np.array([r.position for r in readings]),
        f"{_PREFIX}covariances": np.array([r.covariance for r in readings]),
    }


def stored_waiting(arrays: Mapping[str, AnyArray]) -> dict[int, tuple[PositionReading, ...]]:
    """The readings that wait; their stamps are those of their records' places of the antenna.

    Raises
    ------
    ValueError
        If the arrays do not belong to each other, or to the submaps.
    """
    if f"{_PREFIX}records" not in arrays:
        return {}
    records, places, P = (arrays[f"{_PREFIX}{name}"] for name in ("records", "positions", "covariances"))
    n, waiting = len(records), {}
    if records.dtype.kind != "i" or records.shape != (n,) or places.shape != (n, 3) or P.shape != (n, 3, 3):
        raise ValueError(f"the {n} positions that wait have other numbers of records, places or covariances")
    np.linalg.cholesky(P)
    for record in dict.fromkeys(records.tolist()):
        own, ids = np.nonzero(records == record)[0].tolist(), arrays[f"submap_{record}/landmark_ids"]
        stamps = position_stamps(ids[is_position_id(ids)]).tolist()
        if len(stamps) != len(own):
            raise ValueError(f"{len(own)} positions wait with submap {record}, which has {len(stamps)} of the antenna")
        waiting[record] = tuple(PositionReading(s, places[k], P[k]) for s, k in zip(stamps, own, strict=True))
    return waiting
