"""Compiled loops of :class:`~sjsam_node.growing_problem.GrowingProblem` over some of its local maps.

``slots`` are the unknowns of each local map as a run (reference pose, end pose, landmarks), -1 for what is fixed.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

from sjsam_node.kernels import local_gradient, local_normal_equations, work_space
from slam_core.clique_kernels import add_element, add_packed
from slam_core.multifrontal_kernels import close_front, open_front


@njit(cache=True, nogil=True)
def evaluate(model, chosen, maps, R, t, points):
    """Cost of each chosen map and their gradients one after the other."""
    total = 0
    for f in chosen:
        total += maps[5][f + 1] - maps[5][f] + 6
    costs, gradients = np.empty(len(chosen)), np.empty(total)
    at = 0
    for k in range(len(chosen)):
        cost, g = local_gradient(model, chosen[k], maps, R, t, points)
        costs[k] = cost
        gradients[at : at + len(g)] = g
        at += len(g)
    return costs, gradients


@njit(cache=True, nogil=True)
def replace(chosen, new, ptr, slots, own, total):
    """Put new gradients of the chosen maps in the place of their ``own``, also in the ``total``."""
    at = 0
    for f in chosen:
        for k in range(ptr[f], ptr[f + 1]):
            if slots[k] >= 0:
                total[slots[k]] += new[at] - own[k]
            own[k] = new[at]
            at += 1


@njit(cache=True, nogil=True)
def touched(chosen, ptr, slots, x):
    """Those of the chosen maps of which some unknown differs from zero in ``x``."""
    out = np.empty(len(chosen), np.int64)
    count = 0
    for f in chosen:
        for k in range(ptr[f], ptr[f + 1]):
            if slots[k] >= 0 and x[slots[k]] != 0.0:
                out[count] = f
                count += 1
                break
    return out[:count]


@njit(cache=True, nogil=True)
def first_home(chosen, ptr, slots, home):
    """The first clique that eliminates an unknown of each chosen map."""
    out = np.empty(len(chosen), np.int64)
    for i in range(len(chosen)):
        out[i] = -1
        for k in range(ptr[chosen[i]], ptr[chosen[i] + 1]):
            if slots[k] >= 0 and (out[i] < 0 or home[slots[k]] < out[i]):
                out[i] = home[slots[k]]
    return out


@njit(cache=True, nogil=True)
def factorize(model, chosen, maps, R, t, points, elements, left, symbolic, value_ptr, values, stack):
    """Eliminate the chosen local maps, linearised at the given state, and what ``left`` says, into the ``values`` of a
    clique tree. Each element goes whole into the first front that eliminates an unknown of it, so that what a front
    leaves over is all that its subtree says.

    elements: unknowns in postorder of the chosen maps, then of ``left`` (runs), and their order by first front (runs).
    left: lower triangles, as runs.
    """
    row_ptr, rows, first_ptr, by_first = elements
    left_ptr, packed = left
    _, _, width, start, column_ptr, front_ptr, front_rows, size, eliminated, _, _ = symbolic
    slot, where = np.empty(len(width), np.int64), np.empty(start[-1], np.int64)
    waiting = np.full((2, len(size)), -1, np.int64)
    work = work_space(maps)
    top = 0
    for s in range(len(size)):
        P, U = open_front(s, symbolic, value_ptr[s], slot, values, stack, top)
        for c in range(column_ptr[s], column_ptr[s + 1]):
            for p in range(width[c]):
                where[start[c] + p] = slot[c] + p
        for k in range(front_ptr[s], front_ptr[s + 1]):
            for p in range(width[front_rows[k]]):
                where[start[front_rows[k]] + p] = slot[front_rows[k]] + p
        for k in range(first_ptr[s], first_ptr[s + 1]):
            e = by_first[k]
            own = rows[row_ptr[e] : row_ptr[e + 1]]
            if e < len(chosen):
                H, _ = local_normal_equations(model, chosen[e], maps, R, t, points, work)
                add_element(H, own, where, P, U)
            else:
                o = e - len(chosen)
                add_packed(packed[left_ptr[o] : left_ptr[o + 1]], own, where, P, U)
        top = close_front(s, symbolic, value_ptr[s], slot, waiting, values, stack, top)
        if top < 0:
            return False
        h = size[s] - eliminated[s]
        at, source = value_ptr[s] + size[s] * eliminated[s], top - h * h
        for i in range(h):
            for j in range(i + 1):
                values[at] = stack[source + i * h + j]
                at += 1
    return True
