"""A Cholesky factor that grows: a tree of cliques, of which only the part above a change is eliminated anew.

A clique holds the unknowns that one front of a multifrontal factor eliminates, the unknowns that it leaves to those
above it, its panel of L, and its update matrix: all that the subtree below says about what is left. Where the matrix
changes, the cliques that eliminate the unknowns in question and all above them are taken off; what hung below them
enters the new elimination through its update matrices, as it is (the Bayes tree of Kaess, Johannsson, Roberts, Ila,
Leonard and Dellaert 2012, with supernodes for cliques).

Cliques are only ever added at the end of the arrays, children before their parents. A copy made before therefore
stays valid, and costs no more than the small arrays.
"""

from __future__ import annotations

import copy

import numpy as np
import numpy.typing as npt

from slam_core import clique_kernels as kernels
from slam_core.block_pattern import IntArray, pointers
from slam_core.elimination_tree import Symbolic
from slam_core.geometry import FloatArray
from slam_core.growing import Growing, GrowingRuns

BoolArray = npt.NDArray[np.bool_]


class CliqueTree:
    """Factor over unknowns 0 ... n - 1, of which each is eliminated by one clique or is not there (yet)."""

    def __init__(self) -> None:
        self._unknowns = GrowingRuns(np.int64)
        self._values = GrowingRuns(np.float64)
        self._width = Growing(np.int64)
        self._parent = Growing(np.int64)
        self._alive = Growing(np.bool_)
        self._home = Growing(np.int64)
        self._place = Growing(np.int64)
        self._kept = 0

    def copy(self) -> CliqueTree:
        """The tree as it is now, whatever becomes of this one."""
        other = copy.copy(self)
        other._unknowns, other._values, other._width = self._unknowns.fork(), self._values.fork(), self._width.fork()
        for name in ("_parent", "_alive", "_home", "_place"):
            setattr(other, name, getattr(self, name).copy())
        return other

    @property
    def wasted(self) -> float:
        """Share of the stored values that belongs to cliques taken off."""
        return 1.0 - self._kept / max(len(self._values.data), 1)

    @property
    def is_empty(self) -> bool:
        """Whether all cliques have been taken off; those without unknowns do not count."""
        return not np.any(self._alive.data & (self._width.data > 0))

    def covering(self, unknowns: IntArray) -> IntArray:
        """Cliques that eliminate any of these unknowns, and all above them."""
        homes = self._home.data[unknowns[unknowns < len(self._home)]]
        return np.asarray(kernels.path_to_roots(self._parent.data, np.unique(homes[homes >= 0])))

    @property
    def homes(self) -> IntArray:
        """The clique that eliminates each unknown, -1 for one that is not there."""
        return np.asarray(self._home.data)

    @property
    def unknowns(self) -> int:
        """Number of unknowns that are there."""
        return int(np.count_nonzero(self._home.data >= 0))

    def is_off(self, cliques: IntArray) -> BoolArray:
        """Whether cliques have been taken off; True for -1, no clique."""
        return np.where(cliques >= 0, ~self._alive.data[cliques], True) if len(self._alive) else cliques < 0

    def detach(self, cliques: IntArray) -> IntArray:
        """Take cliques off, with all above them; what hung below, as numbers for :meth:`left_over`."""
        alive, parent = self._alive.data, self._parent.data
        alive[cliques] = False
        self._kept -= int(self._values.sizes(cliques).sum())
        for c in cliques.tolist():
            self._home.data[self._unknowns[c][: self._width.data[c]]] = -1
        below = np.zeros(len(alive) + 1, dtype=np.bool_)
        below[cliques] = True
        return np.nonzero(alive & (parent >= 0) & below[parent])[0]

    def left_over(self, clique: int) -> tuple[IntArray, FloatArray]:
        """Unknowns (h,) that a clique leaves to those above it, and the lower triangle, row by row, of all that its
        subtree says about them.
        """
        w, rows = int(self._width.data[clique]), self._unknowns[clique]
        return rows[w:], self._values[clique][len(rows) * w :]

    def room(self, symbolic: Symbolic) -> tuple[IntArray, FloatArray]:
        """Where the values of new cliques go that :meth:`attach` will put on top: the panel of each row by row, then
        the lower triangle of what it leaves over, row by row.
        """
        left = symbolic.size - symbolic.eliminated
        ptr = pointers(symbolic.size * symbolic.eliminated + left * (left + 1) // 2)
        return ptr, self._values.more(ptr)

    def attach(self, symbolic: Symbolic, ordered: IntArray, orphans: IntArray) -> None:
        """Put the cliques for which there is :meth:`room` on top of ``orphans``; ``ordered`` are their unknowns in
        postorder.
        """
        first, count = len(self._width), len(symbolic.size)
        self._reserve(int(ordered.max(initial=-1)) + 1)
        self._unknowns.extend(*kernels.front_unknowns(symbolic, ordered))
        self._width.extend(symbolic.eliminated)
        self._kept += int(self._values.sizes(np.arange(first, first + count)).sum())
        self._parent.extend(np.where(symbolic.parent >= 0, symbolic.parent + first, -1))
        self._alive.extend(np.ones(count, dtype=np.bool_))
        self._home.data[ordered] = first + np.repeat(np.arange(count), symbolic.eliminated)
        inside = np.repeat(pointers(symbolic.eliminated)[:-1], symbolic.eliminated)
        self._place.data[ordered] = np.arange(len(ordered)) - inside
        for c in orphans.tolist():
            self._parent.data[c] = self._home.data[self.left_over(c)[0]].min()

    def _reserve(self, count: int) -> None:
        missing = count - len(self._home)
        if missing > 0:
            self._home.extend(np.full(missing, -1, dtype=np.int64))
            self._place.extend(np.zeros(missing, dtype=np.int64))

    def step(self, gradient: FloatArray, least: float) -> tuple[FloatArray, float]:
        """``-A^-1 gradient``, and what it promises, its decrement ``-gradient^T step``.

        Only what the gradient acts on and what that moves is touched: a clique stays where it is if to move it would
        gain less than ``least``, in units of the decrement.
        """
        x = -gradient
        kernels.step(self._tables(), x, least)
        return x, float(-gradient @ x)

    def covariance(self, unknowns: IntArray) -> FloatArray:
        """Block (k, k) of the inverse."""
        W = kernels.unit_columns(self._tables(), self._home.data, self._place.data, unknowns)
        return np.asarray(W.T @ W)

    def _tables(self) -> tuple[FloatArray | IntArray, ...]:
        return (self._alive.data, self._parent.data, self._width.data, self._unknowns.ptr, self._unknowns.data,
                self._values.ptr, self._values.data)  # fmt: skip
