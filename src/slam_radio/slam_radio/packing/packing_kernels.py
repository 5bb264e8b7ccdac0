# SPDX-License-Identifier: Apache-2.0
"""Compiled: products of symmetric matrices and of block-diagonal ones, and the search for points beside others.

A block-diagonal matrix has a pose's block of 6, then landmarks' of 3.

``pose`` (6, 6) and ``blocks`` (n, 3, 3) are the blocks of A; matrices are (6 + 3n, 6 + 3n).
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def between(pose, blocks, S, out):
    """``out`` = A S A', of a symmetric S."""
    m = len(S)
    left = np.empty((6, m), dtype=out.dtype)
    for i in range(len(blocks) + 1):
        a, count = (0, 6) if i == 0 else (3 + 3 * i, 3)
        for p in range(count):  # left = A_i S_i
            row = left[p]
            for k in range(count):
                factor, of = pose[p, k] if i == 0 else blocks[i - 1, p, k], S[a + k]
                if k == 0:
                    for c in range(a + count):
                        row[c] = factor * of[c]
                else:
                    for c in range(a + count):
                        row[c] += factor * of[c]
        for p in range(count):
            row, to = left[p], out[a + p]
            for q in range(6):
                value = row[0] * pose[q, 0]
                for k in range(1, 6):
                    value += row[k] * pose[q, k]
                to[q] = value
            for j in range(i):
                b = 6 + 3 * j
                x, y, z, B = row[b], row[b + 1], row[b + 2], blocks[j]
                to[b] = B[0, 0] * x + B[0, 1] * y + B[0, 2] * z
                to[b + 1] = B[1, 0] * x + B[1, 1] * y + B[1, 2] * z
                to[b + 2] = B[2, 0] * x + B[2, 1] * y + B[2, 2] * z
    for x in range(m):
        for y in range(x):
            out[y, x] = out[x, y]


@njit(cache=True, nogil=True)
def times(pose, blocks, M, out):
    """``out`` = A M, (6 + 3n, k)."""
    out[:] = 0
    for i in range(len(blocks) + 1):
        a, count = (0, 6) if i == 0 else (3 + 3 * i, 3)
        for p in range(count):
            row = out[a + p]
            for q in range(count):
                factor, of = pose[p, q] if i == 0 else blocks[i - 1, p, q], M[a + q]
                for c in range(len(row)):
                    row[c] += factor * of[c]


@njit(cache=True, nogil=True)
def with_blocks(pose, blocks, S, out):
    """``out`` += A - S, the lower triangle alone; A is symmetric."""
    for x in range(len(S)):
        for y in range(x + 1):
            out[x, y] -= S[x, y]
    for p in range(6):
        for q in range(p + 1):
            out[p, q] += pose[p, q]
    for i in range(len(blocks)):
        a = 6 + 3 * i
        for p in range(3):
            for q in range(p + 1):
                out[a + p, a + q] += blocks[i, p, q]


@njit(cache=True, nogil=True)
def crowded(points, reach):
    """Mask (n,) of points (n, 3) within ``reach`` (n,) of an earlier one that is not crowded itself."""
    out = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        for j in range(i):
            if not out[j]:
                x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
                if x * x + y * y + z * z <= reach[i] * reach[i]:
                    out[i] = True
                    break
    return out
