# SPDX-License-Identifier: Apache-2.0
"""Hash table from the integer coordinates of a block to its row, for the compiled kernels.

Blocks are kept in bricks of 4 x 4 x 4, and only bricks are hashed: the eight blocks around a place lie in two of them
in the mean, and neighbours in a picture mostly in one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.runtime.in_place import in_place

IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]

_OFFSET = 1 << 20
MAX_CELLS_PER_AXIS = _OFFSET - 4
"""Largest absolute block coordinate that the packed 63-bit key can hold."""
_SHIFT = 2
"""Logarithm of a brick's edge, in blocks."""
_MASK = (1 << _SHIFT) - 1
_BRICK = 1 << (3 * _SHIFT)
"""Blocks of a brick."""


class BlockTable(NamedTuple):
    """Rows of blocks: ``keys`` (s,) of bricks, -1 in empty slots, their ``numbers`` (s,) and ``rows`` (b, 64).

    A row is -1 where there is no block. ``used`` (1,): number of bricks.
    """

    keys: IntArray
    numbers: Int32Array
    rows: Int32Array
    used: Int32Array


@njit(cache=True, nogil=True, inline="always")
def brick_key(ix: int, iy: int, iz: int) -> int:
    """Key of the brick of a block; the table's empty slots hold -1, which no key is."""
    return (((ix >> _SHIFT) + _OFFSET) << 42) | (((iy >> _SHIFT) + _OFFSET) << 21) | ((iz >> _SHIFT) + _OFFSET)


@njit(cache=True, nogil=True, inline="always")
def place_in_brick(ix: int, iy: int, iz: int) -> int:
    """Place of a block in its brick."""
    return ((ix & _MASK) << (2 * _SHIFT)) | ((iy & _MASK) << _SHIFT) | (iz & _MASK)


@njit(cache=True, nogil=True, inline="always")
def in_one_brick(ax: int, ay: int, az: int, bx: int, by: int, bz: int) -> bool:
    """True if two blocks lie in the same brick."""
    return (((ax ^ bx) | (ay ^ by) | (az ^ bz)) >> _SHIFT) == 0


@in_place()
def _slot_of(keys: IntArray, key: int) -> int:
    """Place of ``key`` in the table, or of the empty slot where it belongs (linear probing, Fibonacci hashing)."""
    mask = keys.shape[0] - 1
    mixed = key * np.int64(-7046029254386353131)
    slot = ((mixed >> 32) ^ mixed) & mask
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & mask
    return int(slot)


@in_place()
def find_block(table: BlockTable, ix: int, iy: int, iz: int) -> int:
    """Row of the block at integer coordinates, -1 where there is none."""
    slot = _slot_of(table.keys, brick_key(ix, iy, iz))
    return int(table.rows[table.numbers[slot], place_in_brick(ix, iy, iz)]) if table.keys[slot] != -1 else -1


@in_place()
def brick_of(table: BlockTable, key: int) -> int:
    """Number of the brick with this key, a new one if need be; see :func:`with_room`."""
    slot = _slot_of(table.keys, key)
    if table.keys[slot] == -1:
        number = table.used[0]
        table.keys[slot], table.numbers[slot] = key, number
        table.rows[number] = -1
        table.used[0] = number + 1
    return int(table.numbers[slot])


@in_place()
def brick_around(table, x, y, z, ix, iy, iz, bricks):  # type: ignore[no-untyped-def]
    """Number of the brick of block (ix, iy, iz), one of the eight from (x, y, z) on; ``bricks`` (8,) keeps those known.

    -1 where none is known yet.
    """
    side = (
        ((ix >> _SHIFT) - (x >> _SHIFT)) + 2 * ((iy >> _SHIFT) - (y >> _SHIFT)) + 4 * ((iz >> _SHIFT) - (z >> _SHIFT))
    )
    if bricks[side] < 0:
        bricks[side] = brick_of(table, brick_key(ix, iy, iz))
    return bricks[side]


@njit(cache=True, nogil=True)
def block_table(bricks: int) -> BlockTable:
    """Empty table with room for so many bricks."""
    size = 16
    while size < 2 * bricks:
        size *= 2
    return BlockTable(
        np.full(size, -1, np.int64),
        np.empty(size, np.int32),
        np.empty((size // 2, _BRICK), np.int32),
        np.zeros(1, np.int32),
    )


@in_place()
def has_room(table: BlockTable, bricks: int) -> bool:
    """True if so many more bricks fit in."""
    return bool(table.used[0] + bricks <= table.rows.shape[0])


@njit(cache=True, nogil=True)
def with_room(table: BlockTable, bricks: int) -> BlockTable:
    """The table, or one of twice the size if it has no room for so many more bricks."""
    used = table.used[0]
    if has_room(table, bricks):
        return table
    larger = block_table(2 * (used + bricks))
    larger.rows[:used] = table.rows[:used]
    larger.used[0] = used
    for i in range(table.keys.shape[0]):
        if table.keys[i] != -1:
            slot = _slot_of(larger.keys, table.keys[i])
            larger.keys[slot], larger.numbers[slot] = table.keys[i], table.numbers[i]
    return larger
