# SPDX-License-Identifier: Apache-2.0
"""The symbolic part of a multifrontal factor: elimination tree, fill, supernodes, and how much memory they need.

Block columns whose factors have the same rows form a *supernode*; its *front* is the dense matrix over its own columns
(w unknowns) and the rows below them (h).
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from slam_core.linear_algebra.block_pattern import BlockPattern, IntArray, pointers


class Symbolic(NamedTuple):
    """Supernodes of a factor. Blocks are numbered in a postorder of the elimination tree.

    given (N,): number in the pattern of each block; label (N,): the inverse. width, start (N + 1,): unknowns of the
    blocks. column_ptr (S + 1,): block columns of each supernode. row_ptr (S + 1,), rows: block rows below them.
    size, eliminated (S,): w + h and w. panel_ptr (S + 1,): panels of L. parent (S,): -1 at a root.
    """

    given: IntArray
    label: IntArray
    width: IntArray
    start: IntArray
    column_ptr: IntArray
    row_ptr: IntArray
    rows: IntArray
    size: IntArray
    eliminated: IntArray
    panel_ptr: IntArray
    parent: IntArray


def analyze(pattern: BlockPattern) -> Symbolic:
    """Elimination tree, fill and supernodes of a pattern."""
    parent, ptr, rows = _fill(pattern.column_ptr, pattern.rows)
    weight = np.concatenate([[0], np.cumsum(pattern.width[rows])])
    below = weight[ptr[1:]] - weight[ptr[:-1]]
    given = _postorder(parent, np.argsort(-(below + pattern.width), kind="stable"))
    label = np.empty_like(given)
    label[given] = np.arange(len(given))
    width = pattern.width[given]
    parent = np.where(parent[given] >= 0, label[parent[given]], -1)
    column_ptr = _supernodes(parent, width, below[given])
    last = given[column_ptr[1:] - 1]
    row_ptr = pointers(ptr[last + 1] - ptr[last])
    supernode = np.repeat(np.arange(len(last)), np.diff(row_ptr))
    below_last = label[rows[np.arange(row_ptr[-1]) + (ptr[last] - row_ptr[:-1])[supernode]]]
    front_rows = np.sort(supernode * len(label) + below_last) % max(len(label), 1)
    start = pointers(width)
    eliminated = np.diff(start[column_ptr])
    size = eliminated + np.diff(pointers(width[front_rows])[row_ptr])
    supernode = np.repeat(np.arange(len(eliminated)), np.diff(column_ptr))
    has_parent = np.diff(row_ptr) > 0
    up = np.full(len(eliminated), -1, dtype=np.int64)
    up[has_parent] = supernode[front_rows[row_ptr[:-1][has_parent]]]
    return Symbolic(
        given, label, width, start, column_ptr, row_ptr, front_rows, size, eliminated, pointers(size * eliminated), up
    )


def update_stack_size(symbolic: Symbolic) -> int:
    """Most that is on the stack of update matrices at a time: those of unfinished parents, and the new one."""
    left = (symbolic.size - symbolic.eliminated) ** 2
    of_children = np.zeros(len(left), dtype=np.int64)
    np.add.at(of_children, symbolic.parent[symbolic.parent >= 0], left[symbolic.parent >= 0])
    after = np.cumsum(left - of_children)
    return int((after + of_children).max(initial=0))


def factor_work(symbolic: Symbolic) -> float:
    """Multiplications of a factorisation: of each front w columns are eliminated from w + h."""
    w, h = symbolic.eliminated.astype(np.float64), (symbolic.size - symbolic.eliminated).astype(np.float64)
    return float((w * (w**2 / 6.0 + w * h / 2.0 + h**2 / 2.0)).sum())


def inverse_stack_size(symbolic: Symbolic) -> int:
    """Most that is on the stack of inverse fronts: a front leaves it when its last child has read it."""
    total = most = 0
    remaining = np.bincount(symbolic.parent[symbolic.parent >= 0], minlength=len(symbolic.parent))
    squares = (symbolic.size**2).tolist()
    for s in range(len(squares) - 1, -1, -1):
        p = int(symbolic.parent[s])
        if p >= 0:
            remaining[p] -= 1
            total -= squares[p] if remaining[p] == 0 else 0
        if remaining[s] > 0:
            total += squares[s]
            most = max(most, total)
    return most


@njit(cache=True, nogil=True)
def _fill(column_ptr, rows):
    """Parent of every block column and its rows below the diagonal in the factor (unsorted).

    The rows are those of the matrix and of its children.
    """
    n = len(column_ptr) - 1
    parent, mark = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    child, sibling = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    ptr, out = np.zeros(n + 1, np.int64), np.empty(2 * len(rows) + n, np.int64)
    for j in range(n):
        first = count = ptr[j]
        if len(out) < first + n:
            out = np.concatenate((out, np.empty(len(out) + n, np.int64)))
        mark[j] = j
        for p in range(column_ptr[j], column_ptr[j + 1]):
            if mark[rows[p]] != j:
                mark[rows[p]] = j
                out[count] = rows[p]
                count += 1
        c = child[j]
        while c >= 0:
            for p in range(ptr[c], ptr[c + 1]):
                if mark[out[p]] != j:
                    mark[out[p]] = j
                    out[count] = out[p]
                    count += 1
            c = sibling[c]
        ptr[j + 1] = count
        if count > first:
            up = out[first]
            for p in range(first + 1, count):
                up = min(up, out[p])
            parent[j] = up
            sibling[j] = child[up]
            child[up] = j
    return parent, ptr, out[: ptr[n]].copy()


@njit(cache=True, nogil=True)
def _postorder(parent, largest_first):
    """Blocks in postorder; of several children that with the largest front comes last, next to its parent."""
    n = len(parent)
    head, following = np.full(n + 1, -1, np.int64), np.full(n, -1, np.int64)
    for j in largest_first:
        up = parent[j] if parent[j] >= 0 else n
        following[j] = head[up]
        head[up] = j
    order, stack = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    stack[0] = n
    depth, done = 1, 0
    while depth > 0:
        top = stack[depth - 1]
        c = head[top]
        if c >= 0:
            head[top] = following[c]
            stack[depth] = c
            depth += 1
        else:
            depth -= 1
            if top < n:
                order[done] = top
                done += 1
    return order


@njit(cache=True, nogil=True)
def _supernodes(parent, width, below):
    """Starts of the supernodes, in postorder.

    Columns of the same rows, then relaxed (Ashcraft and Grimes 1989): a supernode joins its parent behind it where that
    stores few zeros, since larger fronts are worth some.
    """
    n = len(parent)
    starts = np.empty(n + 1, np.int64)
    count = 0
    for j in range(n):
        if j == 0 or parent[j - 1] != j or below[j - 1] != below[j] + width[j]:
            starts[count] = j
            count += 1
    starts[count] = n
    kept = np.empty(n + 1, np.int64)
    kept[0] = n
    found = 1
    w = h = filled = 0
    for s in range(count - 1, -1, -1):
        first, last = starts[s], starts[s + 1] - 1
        own = 0
        for j in range(first, last + 1):
            own += width[j]
        entries = own * (own + below[last])
        joins = False
        if s + 1 < count and parent[last] >= 0 and parent[last] < kept[found - 1]:
            both = own + w
            zeros = 1.0 - (filled + entries) / max(both * (both + h), 1)
            joins = both <= 4 or zeros < (0.7 if both <= 18 else (0.15 if both <= 48 else 0.05))
        if joins:
            w, filled = own + w, filled + entries
        else:
            if s + 1 < count:
                kept[found] = starts[s + 1]
                found += 1
            w, h, filled = own, below[last], entries
    kept[found] = 0
    if n == 0:
        found = 0
    return kept[: found + 1][::-1].copy()
