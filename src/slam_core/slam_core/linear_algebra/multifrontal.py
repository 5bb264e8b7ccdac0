# SPDX-License-Identifier: Apache-2.0
"""Sparse Cholesky factor of a block matrix by the multifrontal method (Duff and Reid 1983; Liu 1992).

Everything symbolic is done on blocks (:mod:`slam_core.linear_algebra.elimination_tree`) and nearly everything numeric
in dense matrix products (:mod:`slam_core.linear_algebra.multifrontal_kernels`). Against a general sparse library this
saves all that is done per unknown instead of per block.
"""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.linear_algebra import multifrontal_kernels as kernels
from slam_core.linear_algebra.block_pattern import BlockPattern, IntArray
from slam_core.linear_algebra.elimination_tree import Symbolic, analyze, inverse_stack_size, update_stack_size


class Multifrontal:
    """Factor of matrices that share one :class:`~slam_core.linear_algebra.block_pattern.BlockPattern`.

    ``L`` is kept as one panel (w + h, w) per supernode, row by row.
    """

    def __init__(self, pattern: BlockPattern) -> None:
        self._entries = (pattern.value_ptr, pattern.height, pattern.column_ptr, pattern.rows, pattern.row_offset)
        self.symbolic = analyze(pattern)
        scalars = pattern.start[:-1][self.symbolic.given]
        inside = np.arange(pattern.n) - np.repeat(self.symbolic.start[:-1], self.symbolic.width)
        self._order = np.repeat(scalars, self.symbolic.width) + inside
        self._position = np.empty_like(self._order)
        self._position[self._order] = np.arange(pattern.n)
        self._panels = np.empty(int(self.symbolic.panel_ptr[-1]))
        self._stack = np.empty(update_stack_size(self.symbolic))

    def factorize(self, values: FloatArray) -> bool:
        """Factor the matrix with these values; False if it is not positive definite."""
        return bool(kernels.factorize(values, self._entries, self.symbolic, self._panels, self._stack))

    def solve(self, rhs: FloatArray) -> FloatArray:
        """``A^-1 rhs``, rhs (n,) or (n, k)."""
        columns = rhs[self._order].reshape(len(rhs), -1).T.copy()
        for x in columns:
            kernels.solve(self.symbolic, self._panels, x)
        return np.asarray(columns.T[self._position].reshape(rhs.shape))

    def inverse_block(self, variables: IntArray) -> FloatArray:
        """Dense block (k, k) of ``A^-1``.

        With ``W = L^-1 E`` it is ``W^T W``, and W differs from zero only above the variables in the elimination tree.
        """
        position = self._position[variables]
        W = kernels.unit_columns(self.symbolic, self._panels, position)
        return np.asarray(W.T @ W)

    def marginal_information(self, variables: IntArray) -> FloatArray:
        """Information of ``variables`` (k,) with all others eliminated; they must be those that are eliminated last.

        With their rows and columns of L it is ``L L^T``.
        """
        symbolic = self.symbolic
        place = np.full(len(self._order), -1, dtype=np.int64)
        place[self._position[variables]] = np.arange(len(variables))
        L = np.zeros((len(variables), len(variables)))
        ends = symbolic.start[symbolic.column_ptr]
        for s in np.unique(np.searchsorted(ends, self._position[variables], side="right") - 1):
            columns = np.arange(ends[s], ends[s + 1])
            below = symbolic.rows[symbolic.row_ptr[s] : symbolic.row_ptr[s + 1]]
            rows = np.concatenate([columns, *(np.arange(symbolic.start[b], symbolic.start[b + 1]) for b in below)])
            panel = self._panels[symbolic.panel_ptr[s] : symbolic.panel_ptr[s + 1]].reshape(len(rows), len(columns))
            own = columns[place[columns] >= 0]
            lower = np.where(rows[:, None] >= own, panel[:, place[columns] >= 0], 0.0)
            inside = place[rows] >= 0
            if lower[~inside].any():
                raise ValueError("others are eliminated after some of these variables")
            L[np.ix_(place[rows[inside]], place[own])] = lower[inside]
        return np.asarray(L @ L.T)

    def inverse_entries(self) -> InversePanels:
        """Exact entries of ``A^-1`` at the nonzeros of the factor (Takahashi, Fagan and Chin 1973)."""
        inverse = np.empty_like(self._panels)
        kernels.invert(self.symbolic, self._panels, inverse, np.empty(inverse_stack_size(self.symbolic)))
        return InversePanels(self.symbolic, inverse, self._position)


class InversePanels:
    """Entries of an inverse inside a factor's pattern."""

    def __init__(self, symbolic: Symbolic, panels: FloatArray, position: IntArray) -> None:
        self._symbolic, self._panels, self._position = symbolic, panels, position
        count = np.diff(symbolic.column_ptr)
        self._supernode = np.repeat(np.arange(len(count)), count)
        self._block = np.repeat(np.arange(len(symbolic.width)), symbolic.width)

    def block(self, variables: IntArray) -> FloatArray:
        """Dense block (k, k) of the inverse for ``variables``; every pair must lie inside the pattern.

        Raises
        ------
        KeyError
            If a pair lies outside; ask the factor's ``inverse_block`` instead.
        """
        position = self._position[variables]
        block: FloatArray = kernels.gather(self._symbolic, self._panels, position, self._block, self._supernode)
        if np.isnan(block).any():
            raise KeyError("inverse entries outside the factor's pattern")
        return block

    def blocks(self, variables: IntArray) -> FloatArray:
        """Dense blocks (n, k, k) of the inverse for ``variables`` (n, k), each inside one block of the pattern."""
        return np.asarray(
            kernels.gather_many(self._symbolic, self._panels, self._position[variables], self._block, self._supernode)
        )
