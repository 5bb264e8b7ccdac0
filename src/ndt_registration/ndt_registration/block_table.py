# SPDX-License-Identifier: Apache-2.0
"""Hash table from the integer coordinates of a block to its row, for the compiled kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.in_place import in_place

IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]

_OFFSET = 1 << 20
MAX_CELLS_PER_AXIS = _OFFSET - 4
"""Largest absolute block coordinate that the packed 63-bit key can hold."""


@njit(cache=True, nogil=True, inline="always")
def pack_key(ix: int, iy: int, iz: int) -> int:
    """Key of a block; the table's empty slots hold -1, which no key is."""
    return ((ix + _OFFSET) << 42) | ((iy + _OFFSET) << 21) | (iz + _OFFSET)


@in_place()
def slot_of(keys: IntArray, key: int) -> int:
    """Place of ``key`` in the table, or of the empty slot where it belongs (linear probing, Fibonacci hashing)."""
    mask = keys.shape[0] - 1
    mixed = key * np.int64(-7046029254386353131)
    slot = ((mixed >> 32) ^ mixed) & mask
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & mask
    return int(slot)


@in_place()
def find_block(keys: IntArray, rows: Int32Array, ix: int, iy: int, iz: int) -> int:
    """Row of the block at integer coordinates, -1 where there is none."""
    slot = slot_of(keys, pack_key(ix, iy, iz))
    return int(rows[slot]) if keys[slot] != -1 else -1


@njit(cache=True, nogil=True)
def hash_table(entries: int) -> IntArray:
    """Empty table, at most half full with so many entries."""
    size = 16
    while size < 2 * entries:
        size *= 2
    return np.full(size, -1, np.int64)


@njit(cache=True, nogil=True)
def doubled(keys: IntArray, rows: Int32Array) -> tuple[IntArray, Int32Array]:
    """The same table with twice the room."""
    new_keys = np.full(2 * keys.shape[0], -1, np.int64)
    new_rows = np.empty(new_keys.shape[0], np.int32)
    for i in range(keys.shape[0]):
        if keys[i] != -1:
            slot = slot_of(new_keys, keys[i])
            new_keys[slot], new_rows[slot] = keys[i], rows[i]
    return new_keys, new_rows
