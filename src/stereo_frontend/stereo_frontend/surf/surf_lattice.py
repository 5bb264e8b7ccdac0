# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that read Haar wavelets around a keypoint from the integral image.

The integral image is read with bilinear interpolation at corners one scale unit s apart, which makes every box sum
exact for any scale and position; all wavelets around a keypoint are differences of the same corners. Lattices are flat
arrays with rows of a fixed length, so that a whole lattice is one loop that the compiler vectorises.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place

STRIDE = 32
"""Numbers from one row of a lattice to the next; at least the corners along a side."""
ONE = np.uintp(1)
"""Unsigned indices cannot be negative, so that the kernels need not look whether they count from the end."""


@njit(cache=True, nogil=True)
def lattice_room(corners):  # type: ignore[no-untyped-def]
    """Room for a lattice of ``corners`` x ``corners``, and for reading a little past its end."""
    return np.zeros(corners * STRIDE + 8)


@njit(cache=True, nogil=True)
def row_room(width, corners):  # type: ignore[no-untyped-def]
    """Room for a row of an image, and for the column beside each corner and the corner's share of the next one."""
    return np.empty(width), np.empty(corners, np.uintp), np.empty(corners)


@in_place()
def read_lattice(integral, keypoint, corners, lattice, room):  # type: ignore[no-untyped-def]
    """Fill ``lattice`` with the integral image at corners one s apart around the keypoint (u, v, scale).

    ``room`` is that of :func:`row_room`. Returns first and last column, first and last row of the corners
    that lie in the image; the others are left as they were.
    """
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    scale = keypoint[2]
    reach = 0.5 * (corners - 1) * scale
    left, top = keypoint[0] + 0.5 - reach, keypoint[1] + 0.5 - reach
    first_x, last_x = max(0, int(np.ceil(-left / scale))), min(corners - 1, int(np.floor((width - left) / scale)))
    first_y, last_y = max(0, int(np.ceil(-top / scale))), min(corners - 1, int(np.floor((height - top) / scale)))
    begin = min(max(int(left + first_x * scale), 0), width - 1)
    end = min(max(int(left + last_x * scale), 0), width - 1) + 2
    row, places, shares = room
    # Which columns lie beside a corner is the same for every row.
    for i in range(first_x, last_x + 1):
        x = left + i * scale
        x0 = min(max(int(x), 0), width - 1)
        places[i], shares[i] = x0 - begin, x - x0
    for j in range(first_y, last_y + 1):
        y = top + j * scale
        y0 = min(max(int(y), 0), height - 1)
        _blend(integral[y0][begin:end], integral[y0 + 1][begin:end], y - y0, row)
        _between(row, places[first_x : last_x + 1], shares[first_x:], lattice[j * STRIDE + first_x :])
    return first_x, last_x, first_y, last_y


@in_place()
def _blend(above, below, share, out):  # type: ignore[no-untyped-def]
    for x in range(len(above)):
        out[x] = above[x] + share * (below[x] - above[x])


@in_place()
def _between(row, places, shares, out):  # type: ignore[no-untyped-def]
    for i in range(len(places)):
        value = row[places[i]]
        out[i] = value + shares[i] * (row[places[i] + ONE] - value)


@in_place()
def haar_wavelets(lattice, corners, inside, half, first_row, line, dx, dy):  # type: ignore[no-untyped-def]
    """Haar responses of size ``2 half`` s: at ``j * STRIDE + i`` the one whose first corner is (first_row + j, i).

    ``inside`` is what :func:`read_lattice` returned; wavelets that reach beyond it are zero. ``line`` is room for a
    lattice; ``dx`` and ``dy`` are float32, whole rows. Columns without enough corners to their right hold nothing of
    use.
    """
    n, far = len(dx), 2 * half
    above, centre = lattice[first_row * STRIDE :], lattice[(first_row + half) * STRIDE :]
    below = lattice[(first_row + far) * STRIDE :]
    for i in range(n + far):
        line[i] = below[i] - above[i]
    for i in range(n):
        dx[i] = line[i] - 2.0 * line[i + half] + line[i + far]
    for i in range(n + far):
        line[i] = below[i] - 2.0 * centre[i] + above[i]
    for i in range(n):
        dy[i] = line[i + far] - line[i]
    first_x, last_x, first_y, last_y = inside
    if first_x > 0 or first_y > 0 or last_x < corners - 1 or last_y < corners - 1:
        _clear_outside((first_x, last_x - far, first_y - first_row, last_y - far - first_row), dx, dy)


@in_place()
def _clear_outside(inside, dx, dy):  # type: ignore[no-untyped-def]
    first_x, last_x, first_y, last_y = inside
    for j in range(len(dx) // STRIDE):
        for i in range(STRIDE):
            if not (first_x <= i <= last_x and first_y <= j <= last_y):
                dx[j * STRIDE + i] = dy[j * STRIDE + i] = np.float32(0.0)
