# SPDX-License-Identifier: Apache-2.0
"""Quantiles of many numbers without sorting them: leading bits tell which few of them have to be sorted.

Floats that are not negative are in the order of their bits, read as integers. Exponent and first bits of the mantissa
part them into classes 3 % wide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numba import njit

from ndt_registration.clouds.block_table import Int32Array
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

_SHIFT = 47
"""Bits behind those of the class: what stays is the sign, the exponent and five bits of the mantissa."""
_CLASSES = 1 << (63 - _SHIFT)
"""Classes without a sign."""


@in_place()
def _count_classes(values: FloatArray, counts: Int32Array) -> None:
    bits = values.view(np.int64)
    for i in range(bits.shape[0]):
        counts[bits[i] >> _SHIFT] += 1


@njit(cache=True, nogil=True)
def _at_rank(values: FloatArray, counts: Int32Array, rank: int) -> tuple[float, float]:
    """Number at place ``rank`` of the rising order, and the next one or, at the end, the last."""
    bits = values.view(np.int64)
    beyond = min(rank + 1, values.shape[0] - 1)
    first = before = 0
    while before + counts[first] <= rank:
        before += counts[first]
        first += 1
    last, held = first, counts[first]
    while before + held <= beyond:
        last += 1
        held += counts[last]
    chosen, used, width = np.empty(held), 0, np.uint64(last - first)
    for i in range(bits.shape[0]):
        if np.uint64((bits[i] >> _SHIFT) - first) <= width:  # those below wrap around
            chosen[used] = values[i]
            used += 1
    chosen.sort()
    return chosen[rank - before], chosen[beyond - before]


def quantiles(values: FloatArray, shares: Sequence[float]) -> list[float]:
    """``np.quantile`` of numbers (n,), n > 0, finite and none of them negative."""
    return [_between(low, high, part) for low, high, part in _ends(values, shares)]


def root_quantiles(squares: FloatArray, shares: Sequence[float]) -> list[float]:
    """:func:`quantiles` of the square roots of such numbers, of which only those asked for are taken."""
    return [_between(float(np.sqrt(low)), float(np.sqrt(high)), part) for low, high, part in _ends(squares, shares)]


def _ends(values: FloatArray, shares: Sequence[float]) -> Iterator[tuple[float, float, float]]:
    """For each share the numbers below and above it, and where it lies between them, 0 to 1."""
    counts = np.zeros(_CLASSES, np.int32)
    _count_classes(values, counts)
    for share in shares:
        place = share * (len(values) - 1)
        yield *_at_rank(values, counts, int(place)), place - int(place)


def _between(low: float, high: float, part: float) -> float:
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)
