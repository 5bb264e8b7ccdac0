# SPDX-License-Identifier: Apache-2.0
"""Sparsity of a symmetric matrix of dense blocks: what the normal equations of poses and landmarks are.

Everything symbolic (order, elimination tree, fill) is done on the blocks, which are far fewer than the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]


def pointers(counts: npt.ArrayLike) -> IntArray:
    """Starts of consecutive runs: 0 and the running sums of ``counts``, shape (n + 1,)."""
    sums = np.cumsum(np.asarray(counts, dtype=np.int64))
    return np.concatenate([np.zeros(1, dtype=np.int64), sums])


@dataclass(frozen=True, eq=False)
class BlockPattern:
    """Lower triangle by block columns.

    width (N,): unknowns of every block; 0 is allowed, such a block has no rows. column_ptr (N + 1,), rows: block rows
    of every block column, ascending, the diagonal first. Values of a matrix with this pattern are stored one block
    column after the other, each a dense panel in column-major order whose rows are those of its blocks. The part of a
    diagonal block above the diagonal is stored, but ignored.
    """

    width: IntArray
    column_ptr: IntArray
    rows: IntArray

    @cached_property
    def start(self) -> IntArray:
        """First unknown of every block, and their number at the end, (N + 1,)."""
        return pointers(self.width)

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return int(self.start[-1])

    @cached_property
    def row_offset(self) -> IntArray:
        """First row of every stored block in its panel, (len(rows),)."""
        above = pointers(self.width[self.rows])
        return np.asarray(above[:-1] - np.repeat(above[self.column_ptr[:-1]], np.diff(self.column_ptr)))

    @cached_property
    def height(self) -> IntArray:
        """Rows of every panel, (N,)."""
        above = pointers(self.width[self.rows])
        return np.asarray(above[self.column_ptr[1:]] - above[self.column_ptr[:-1]])

    @cached_property
    def value_ptr(self) -> IntArray:
        """Starts of the values of every panel, (N + 1,)."""
        return pointers(self.height * self.width)

    @cached_property
    def diagonal(self) -> IntArray:
        """Positions of the diagonal among the values, (n,)."""
        inside = np.arange(self.n) - np.repeat(self.start[:-1], self.width)
        return np.asarray(
            np.repeat(self.value_ptr[:-1], self.width) + inside * (np.repeat(self.height, self.width) + 1)
        )

    def scalar_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every stored value."""
        height, width = self.height, self.width
        per_column = np.repeat(height, width)
        columns = np.repeat(np.arange(self.n, dtype=np.int64), per_column)
        block_height = width[self.rows]
        first = np.repeat(self.start[self.rows] - pointers(block_height)[:-1], block_height)
        panel_rows = first + np.arange(len(first))
        panel_start = np.repeat(pointers(height)[:-1], width)
        shift = np.repeat(panel_start - pointers(per_column)[:-1], per_column)
        return panel_rows[np.arange(len(columns)) + shift], columns
