"""Compiled loops over the cliques of a :class:`~slam_core.clique_tree.CliqueTree`.

``tables``: alive, parent and width (eliminated unknowns) of every clique, its unknowns (own ones first) and its
values (panel row by row, then the lower triangle of the update matrix), as runs. Children stand before parents.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def path_to_roots(parent, cliques):
    """Cliques and all above them, ascending."""
    seen = np.zeros(len(parent), np.bool_)
    for c in cliques:
        up = c
        while up >= 0 and not seen[up]:
            seen[up] = True
            up = parent[up]
    return np.nonzero(seen)[0]


@njit(cache=True, nogil=True)
def front_unknowns(symbolic, ordered):
    """Unknowns of every front, own ones first, as runs; ``ordered`` are the unknowns in postorder."""
    _, _, width, start, column_ptr, row_ptr, rows, size, eliminated, _, _ = symbolic
    ptr = np.zeros(len(size) + 1, np.int64)
    for s in range(len(size)):
        ptr[s + 1] = ptr[s] + size[s]
    out = np.empty(ptr[len(size)], np.int64)
    for s in range(len(size)):
        at, first = ptr[s], start[column_ptr[s]]
        out[at : at + eliminated[s]] = ordered[first : first + eliminated[s]]
        at += eliminated[s]
        for k in range(row_ptr[s], row_ptr[s + 1]):
            out[at : at + width[rows[k]]] = ordered[start[rows[k]] : start[rows[k] + 1]]
            at += width[rows[k]]
    return out, ptr


@njit(cache=True, nogil=True)
def add_element(H, rows, where, P, U):
    """Add a symmetric matrix over the unknowns ``rows`` (-1 for fixed ones) to a front; ``where`` is the row of each
    unknown there.
    """
    w = P.shape[1]
    for i in range(len(rows)):
        if rows[i] < 0:
            continue
        a = where[rows[i]]
        for j in range(len(rows)):
            if rows[j] >= 0:
                b = where[rows[j]]
                if b <= a:
                    if b < w:
                        P[a, b] += H[i, j]
                    else:
                        U[a - w, b - w] += H[i, j]


@njit(cache=True, nogil=True)
def add_packed(packed, rows, where, P, U):
    """The same for a lower triangle that is stored row by row."""
    w, at = P.shape[1], 0
    for i in range(len(rows)):
        for j in range(i + 1):
            a, b = where[rows[i]], where[rows[j]]
            a, b = max(a, b), min(a, b)
            if b < w:
                P[a, b] += packed[at]
            else:
                U[a - w, b - w] += packed[at]
            at += 1


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def step(tables, x, least):
    """``x <- A^-1 x`` where x acts and where that moves something."""
    alive, parent, width, ptr, unknowns, value_ptr, values = tables
    count = len(alive)
    active, touched = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    largest = 0
    for c in range(count):
        largest = max(largest, width[c])
    own = np.empty(largest)
    for c in range(count):
        w, first = width[c], ptr[c]
        if not alive[c]:
            continue
        for i in range(w):
            own[i] = x[unknowns[first + i]]
            if own[i] != 0.0:
                active[c] = True
        if not active[c]:
            continue
        at = value_ptr[c]
        for i in range(w):
            value = own[i]
            for j in range(i):
                value -= values[at + j] * own[j]
            own[i] = value / values[at + i]
            x[unknowns[first + i]] = own[i]
            at += w
        for k in range(first + w, ptr[c + 1]):
            value = 0.0
            for j in range(w):
                value += values[at + j] * own[j]
            x[unknowns[k]] -= value
            at += w
    for c in range(count - 1, -1, -1):
        if not alive[c] or not (active[c] or (parent[c] >= 0 and touched[parent[c]])):
            continue
        w, first = width[c], ptr[c]
        for i in range(w):
            own[i] = x[unknowns[first + i]]
        at = value_ptr[c] + w * w
        for k in range(first + w, ptr[c + 1]):
            value = x[unknowns[k]]
            if value != 0.0:
                touched[c] = True
                for j in range(w):
                    own[j] -= values[at + j] * value
            at += w
        gain = 0.0
        for i in range(w):
            gain += own[i] * own[i]
        if gain < least:
            for i in range(w):
                x[unknowns[first + i]] = 0.0
            continue
        touched[c] = True
        for i in range(w - 1, -1, -1):
            row = value_ptr[c] + i * w
            own[i] /= values[row + i]
            for j in range(i):
                own[j] -= values[row + j] * own[i]
            x[unknowns[first + i]] = own[i]


@njit(cache=True, nogil=True)
def unit_columns(tables, home, place, chosen):
    """``L^-1 E`` for unit columns E at the chosen unknowns, without the rows that stay zero."""
    alive, parent, width, ptr, unknowns, value_ptr, values = tables
    cliques = path_to_roots(parent, home[chosen])
    at = np.full(len(alive), -1, np.int64)
    total = 0
    for c in cliques:
        at[c] = total
        total += width[c]
    x = np.zeros((total, len(chosen)))
    for i in range(len(chosen)):
        x[at[home[chosen[i]]] + place[chosen[i]], i] = 1.0
    for c in cliques:
        w = width[c]
        panel = values[value_ptr[c] : value_ptr[c] + (ptr[c + 1] - ptr[c]) * w].reshape((ptr[c + 1] - ptr[c], w))
        own = x[at[c] : at[c] + w]
        for i in range(w):
            for j in range(i):
                for q in range(len(chosen)):
                    own[i, q] -= panel[i, j] * own[j, q]
            for q in range(len(chosen)):
                own[i, q] /= panel[i, i]
        if len(panel) > w:
            moved = np.dot(panel[w:], own)
            for k in range(len(moved)):
                r = unknowns[ptr[c] + w + k]
                x[at[home[r]] + place[r]] -= moved[k]
    return x
