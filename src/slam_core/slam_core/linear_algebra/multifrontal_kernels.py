# SPDX-License-Identifier: Apache-2.0
"""Compiled numeric part of a multifrontal factor.

``symbolic`` is a :class:`~slam_core.linear_algebra.elimination_tree.Symbolic`.

Fronts are assembled from the matrix and from what their children in the elimination tree left over, w columns are
eliminated, and the rest goes to the parent. All heavy work is done by BLAS on dense matrices.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.linear_algebra.blas_kernels import cholesky, solve_right, subtract_square


@njit(cache=True, nogil=True)
def _number_slots(symbolic, s, slot):
    """Fill ``slot`` with the place of each block in the front of supernode ``s``: its columns, then its rows."""
    _, _, width, start, column_ptr, row_ptr, rows, _, eliminated, _, _ = symbolic
    for c in range(column_ptr[s], column_ptr[s + 1]):
        slot[c] = start[c] - start[column_ptr[s]]
    below = eliminated[s]
    for k in range(row_ptr[s], row_ptr[s + 1]):
        slot[rows[k]] = below
        below += width[rows[k]]


@njit(cache=True, nogil=True)
def factorize(values, entries, symbolic, panels, stack):
    """Eliminate front after front; what a front leaves over waits on the stack for its parent."""
    _, _, width, _, _, row_ptr, rows, size, eliminated, panel_ptr, parent = symbolic
    supernodes = len(size)
    slot = np.empty(len(width), np.int64)
    latest, earlier = np.full(supernodes, -1, np.int64), np.full(supernodes, -1, np.int64)
    top = 0
    for s in range(supernodes):
        m, w = size[s], eliminated[s]
        h = m - w
        _number_slots(symbolic, s, slot)
        P = panels[panel_ptr[s] : panel_ptr[s + 1]].reshape((m, w))
        P[:] = 0.0
        _assemble(values, entries, symbolic, s, slot, P)
        U = stack[top : top + h * h].reshape((h, h))
        U[:] = 0.0
        free = top
        child = latest[s]
        while child >= 0:
            left = size[child] - eliminated[child]
            free -= left * left
            update = stack[free : free + left * left].reshape((left, left))
            _extend_add(update, rows[row_ptr[child] : row_ptr[child + 1]], width, slot, w, P, U)
            child = earlier[child]
        if not cholesky(P[:w]):
            return False
        if h > 0:
            solve_right(P[:w], P[w:])
            subtract_square(P[w:], U)
            stack[free : free + h * h] = stack[top : top + h * h]
            earlier[s] = latest[parent[s]]
            latest[parent[s]] = s
        top = free + h * h
    return True


@njit(cache=True, nogil=True)
def _assemble(values, entries, symbolic, s, slot, P):
    """Entries of the matrix in the columns of a supernode; only the lower triangle is written."""
    value_ptr, height, pattern_ptr, pattern_rows, row_offset = entries
    given, label, width, column_ptr = symbolic[0], symbolic[1], symbolic[2], symbolic[4]
    for c in range(column_ptr[s], column_ptr[s + 1]):
        g = given[c]
        for k in range(pattern_ptr[g], pattern_ptr[g + 1]):
            r = label[pattern_rows[k]]
            for q in range(width[c]):
                source = value_ptr[g] + q * height[g] + row_offset[k]
                for p in range(q if r == c else 0, width[r]):
                    P[slot[r] + p, slot[c] + q] = values[source + p]


@njit(cache=True, nogil=True)
def _runs(rows, width, slot):
    """Stretches of a child's rows that stand side by side in the parent's front: source, target, length."""
    source, target = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    length = np.empty(len(rows), np.int64)
    count = at = 0
    for k in range(len(rows)):
        here = slot[rows[k]]
        if count > 0 and target[count - 1] + length[count - 1] == here:
            length[count - 1] += width[rows[k]]
        else:
            source[count], target[count], length[count] = at, here, width[rows[k]]
            count += 1
        at += width[rows[k]]
    return source[:count], target[:count], length[:count]


@njit(cache=True, nogil=True)
def _extend_add(update, rows, width, slot, w, P, U):
    """Add what a child left over (lower triangle) to the front of its parent: pivot columns P, the rest U."""
    source, target, length = _runs(rows, width, slot)
    for a in range(len(source)):
        for i in range(length[a]):
            row, at = source[a] + i, target[a] + i
            for b in range(a + 1):
                n = length[b] if b < a else i + 1
                first, to = source[b], target[b]
                pivots = min(max(w - to, 0), n)
                for j in range(pivots):
                    P[at, to + j] += update[row, first + j]
                for j in range(pivots, n):
                    U[at - w, to + j - w] += update[row, first + j]


@njit(cache=True, nogil=True)
def _inverse_of_lower(L, k, b):
    """Inverse of the triangle of ``L`` that starts at (k, k), (b, b)."""
    out = np.zeros((b, b))
    for i in range(b):
        for t in range(i):
            scale = L[k + i, k + t]
            for j in range(t + 1):
                out[i, j] -= scale * out[t, j]
        for j in range(i):
            out[i, j] /= L[k + i, k + i]
        out[i, i] = 1.0 / L[k + i, k + i]
    return out


@njit(cache=True, nogil=True)
def _lower_step(P, w, x):
    """``x <- L_JJ^-1 x`` in place for the triangle of a panel."""
    for i in range(w):
        for j in range(i):
            value = P[i, j]
            for q in range(x.shape[1]):
                x[i, q] -= value * x[j, q]
        for q in range(x.shape[1]):
            x[i, q] /= P[i, i]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def solve(symbolic, panels, x):
    """``x <- L^-T L^-1 x``, x (n,) in postorder."""
    _, _, _, start, column_ptr, row_ptr, rows, size, eliminated, panel_ptr, _ = symbolic
    for s in range(len(size)):
        w, P = eliminated[s], panels[panel_ptr[s] : panel_ptr[s + 1]]
        own = x[start[column_ptr[s]] : start[column_ptr[s]] + w]
        at = 0
        for i in range(w):
            value = own[i]
            for j in range(i):
                value -= P[at + j] * own[j]
            own[i] = value / P[at + i]
            at += w
        for k in range(row_ptr[s], row_ptr[s + 1]):
            r = rows[k]
            for p in range(start[r], start[r + 1]):
                value = 0.0
                for j in range(w):
                    value += P[at + j] * own[j]
                x[p] -= value
                at += w
    for s in range(len(size) - 1, -1, -1):
        w, P = eliminated[s], panels[panel_ptr[s] : panel_ptr[s + 1]]
        own = x[start[column_ptr[s]] : start[column_ptr[s]] + w]
        at = w * w
        for k in range(row_ptr[s], row_ptr[s + 1]):
            r = rows[k]
            for p in range(start[r], start[r + 1]):
                value = x[p]
                for j in range(w):
                    own[j] -= P[at + j] * value
                at += w
        for i in range(w - 1, -1, -1):
            own[i] /= P[i * w + i]
            for j in range(i):
                own[j] -= P[i * w + j] * own[i]


@njit(cache=True, nogil=True)
def unit_columns(symbolic, panels, position):
    """``L^-1 E`` for unit columns E at some positions, without the rows that stay zero.

    Only supernodes above the positions in the tree are touched.
    """
    _, _, width, start, column_ptr, row_ptr, rows, size, eliminated, panel_ptr, parent = symbolic
    active = np.zeros(len(size), np.bool_)
    for p in position:
        block = np.searchsorted(start, p, side="right") - 1
        s = np.searchsorted(column_ptr, block, side="right") - 1
        while s >= 0 and not active[s]:
            active[s] = True
            s = parent[s]
    at = np.full(len(start), -1, np.int64)
    total = 0
    for s in range(len(size)):
        if active[s]:
            for c in range(column_ptr[s], column_ptr[s + 1]):
                at[c] = total
                total += width[c]
    x = np.zeros((total, len(position)))
    for i in range(len(position)):
        block = np.searchsorted(start, position[i], side="right") - 1
        x[at[block] + position[i] - start[block], i] = 1.0
    for s in range(len(size)):
        if not active[s]:
            continue
        m, w = size[s], eliminated[s]
        P = panels[panel_ptr[s] : panel_ptr[s + 1]].reshape((m, w))
        first = at[column_ptr[s]]
        own = x[first : first + w]
        _lower_step(P, w, own)
        if m > w:
            moved = np.dot(panels[panel_ptr[s] + w * w : panel_ptr[s + 1]].reshape((m - w, w)), own)
            row = 0
            for k in range(row_ptr[s], row_ptr[s + 1]):
                r = rows[k]
                x[at[r] : at[r] + width[r]] -= moved[row : row + width[r]]
                row += width[r]
    return x


@njit(cache=True, nogil=True)
def _part_of_parent(above, rows, width, slot, h):
    """Rows and columns (h, h) of the parent's front of the inverse that belong to a child."""
    source, target, length = _runs(rows, width, slot)
    known = np.empty((h, h))
    for a in range(len(source)):
        for i in range(length[a]):
            for b in range(len(source)):
                known[source[a] + i, source[b] : source[b] + length[b]] = above[
                    target[a] + i, target[b] : target[b] + length[b]
                ]
    return known


@njit(cache=True, nogil=True)
def invert(symbolic, panels, inverse, stack):
    """Panels of the inverse, from the root down.

    With ``Y = L_IJ L_JJ^-1`` the front of the inverse is ``Z_IJ = -Z_II Y`` and ``Z_JJ = L_JJ^-T L_JJ^-1 - Y^T Z_IJ``;
    ``Z_II`` is part of the parent's front.
    """
    _, _, width, _, _, row_ptr, rows, size, eliminated, panel_ptr, parent = symbolic
    supernodes = len(size)
    children, at = np.zeros(supernodes, np.int64), np.zeros(supernodes, np.int64)
    for s in range(supernodes):
        if parent[s] >= 0:
            children[parent[s]] += 1
    slot = np.empty(len(width), np.int64)
    top = 0
    for s in range(supernodes - 1, -1, -1):
        m, w = size[s], eliminated[s]
        h, p = m - w, parent[s]
        Z = np.empty((m, m))
        triangle = _inverse_of_lower(panels[panel_ptr[s] : panel_ptr[s + 1]].reshape((m, w)), 0, w)
        corner = np.dot(triangle.T, triangle)
        if p >= 0:
            _number_slots(symbolic, p, slot)
            above = stack[at[p] : at[p] + size[p] * size[p]].reshape((size[p], size[p]))
            known = _part_of_parent(above, rows[row_ptr[s] : row_ptr[s + 1]], width, slot, h)
            children[p] -= 1
            if children[p] == 0:
                top = at[p]
            Y = np.dot(panels[panel_ptr[s] + w * w : panel_ptr[s + 1]].reshape((h, w)), triangle)
            side = -np.dot(known, Y)
            corner -= np.dot(Y.T, side)
            Z[w:, w:] = known
            Z[w:, :w] = side
            Z[:w, w:] = side.T
        # What rounding leaves of asymmetry would grow from front to front along a long way.
        Z[:w, :w] = 0.5 * (corner + corner.T)
        inverse[panel_ptr[s] : panel_ptr[s + 1]] = Z[:, :w].copy().reshape(m * w)
        if children[s] > 0:
            at[s] = top
            stack[top : top + m * m] = Z.reshape(m * m)
            top += m * m


@njit(cache=True, nogil=True)
def gather(symbolic, panels, position, block_of, supernode_of):
    """Dense block of the inverse; NaN where an entry is outside the pattern."""
    _, _, width, start, column_ptr, row_ptr, rows, _, eliminated, panel_ptr, _ = symbolic
    n = len(position)
    out = np.full((n, n), np.nan)
    for a in range(n):
        column = position[a]
        s = supernode_of[block_of[column]]
        inside = column - start[column_ptr[s]]
        below = rows[row_ptr[s] : row_ptr[s + 1]]
        offset = np.zeros(len(below) + 1, np.int64)
        for k in range(len(below)):
            offset[k + 1] = offset[k] + width[below[k]]
        for b in range(n):
            row, block = position[b], block_of[position[b]]
            at = -1
            if supernode_of[block] == s:
                at = row - start[column_ptr[s]]
            elif row > column:
                k = np.searchsorted(below, block)
                if k < len(below) and below[k] == block:
                    at = eliminated[s] + offset[k] + row - start[block]
            if at >= 0:
                out[a, b] = out[b, a] = panels[panel_ptr[s] + at * eliminated[s] + inside]
    return out


@njit(cache=True, nogil=True)
def gather_many(symbolic, inverse, positions, block, supernode):
    """Entries (n, k, k) of the inverse for each row of ``positions`` (n, k)."""
    n, k = positions.shape
    out = np.empty((n, k, k))
    for i in range(n):
        out[i] = gather(symbolic, inverse, positions[i], block, supernode)
    return out
