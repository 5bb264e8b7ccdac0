# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the SURF-128 descriptor (Bay et al. 2008, section 4).

A square of 20 x 20 samples, one per scale unit s, is covered by Haar wavelets of size 2s. Each of 4 x 4 subregions sums
dx and |dx| separately by the sign of dy, and dy and |dy| by the sign of dx: 8 numbers each, 128 in all, normalised.
The wavelets are those of :mod:`stereo_frontend.surf.surf_lattice`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place
from slam_core.types import Float32Array
from stereo_frontend.surf.surf_lattice import ONE, STRIDE, haar_wavelets, lattice_room, read_lattice, row_room

SAMPLES = 20
UPRIGHT_CORNERS = SAMPLES + 2
TURNED_CORNERS = 31
"""Corners along each side that a square needs however it is turned."""
_NODES = TURNED_CORNERS - 2
"""Wavelets along each side of that lattice."""
_TERMS = 8
"""Numbers per subregion."""
_ROW = _TERMS * SAMPLES
_FIRST_SAMPLE = np.float32(-0.5 * (SAMPLES - 1))
DIMENSION = 16 * _TERMS
WEIGHT_SIGMA = 5.0
"""Width of the Gaussian over the samples, in scale units. The paper has 3.3; on EuRoC and KITTI pairs 5 raised the
precision of
mutual matches from 0.90 to 0.91 and from 0.82 to 0.85 with 5 % more of them."""

DIRECTIONS = 36
_WINDOW = DIRECTIONS // 6
DISC_RADIUS = 6
_SIDE = 2 * DISC_RADIUS + 1
_FIRST = (TURNED_CORNERS - 4) // 2 - DISC_RADIUS
"""First row and column of the wavelets of size 4s that the orientation takes: a disc of this radius around the
middle.
"""


def _disc() -> tuple[np.ndarray, np.ndarray]:
    """Places of the disc's wavelets in a lattice that begins at its first row, and their Gaussian weights."""
    along = np.arange(_SIDE) - DISC_RADIUS
    squared = along[:, None] ** 2 + along[None, :] ** 2
    j, i = np.nonzero(squared <= DISC_RADIUS**2)
    return j * STRIDE + _FIRST + i, np.exp(-squared[j, i] / 8.0)


_DISC, _DISC_WEIGHTS = _disc()

_PER_QUADRANT = DIRECTIONS // 4
_BORDERS = np.tan(np.arange(1, _PER_QUADRANT) * (0.5 * np.pi / _PER_QUADRANT)).astype(np.float32)
"""Tangents of the directions that divide a quadrant."""


def region_weights(samples: int = SAMPLES, sigma: float = WEIGHT_SIGMA) -> Float32Array:
    """Weight of every sample of one axis in each of the four subregions, (4, samples): Gaussian, with soft borders.

    A sample counts for the two subregions beside it in proportion to its distance from their centres, so that a small
    shift does not move it from one number to another. ``sigma`` is the width of the Gaussian, in samples.
    """
    width = samples / 4
    position = np.arange(samples) - (samples - 1) / 2.0
    centres = (np.arange(4) - 1.5) * width
    overlap = np.clip(1.0 - np.abs(position[None, :] - centres[:, None]) / width, 0.0, 1.0)
    return np.asarray(overlap * np.exp(-0.5 * (position / sigma) ** 2), np.float32)


def merged_signs(descriptors: Float32Array) -> Float32Array:
    """SURF-64 (n, 64) of SURF-128 (n, 128): the sums of dx, |dx|, dy and |dy|, no longer split by the other's sign."""
    split = descriptors.reshape(-1, 2, 2)
    merged = split.sum(axis=1).reshape(len(descriptors), DIMENSION // 2)
    norm = np.sqrt(np.einsum("nd,nd->n", merged, merged))
    return np.asarray(merged / np.maximum(norm, np.float32(1e-12))[:, None], np.float32)


@njit(cache=True, nogil=True)
def describe_upright(integral, keypoints, weights, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 128) for keypoints (n, 3) of u, v, scale with wavelets along the axes of the image."""
    lattice, line, room = (
        lattice_room(UPRIGHT_CORNERS),
        lattice_room(UPRIGHT_CORNERS),
        row_room(integral.shape[1], UPRIGHT_CORNERS),
    )
    dx, dy = np.empty(SAMPLES * STRIDE, np.float32), np.empty(SAMPLES * STRIDE, np.float32)
    split, total = np.empty((SAMPLES, _ROW), np.float32), np.empty((2, _ROW), np.float32)
    for k in range(keypoints.shape[0]):
        inside = read_lattice(integral, keypoints[k], UPRIGHT_CORNERS, lattice, room)
        haar_wavelets(lattice, UPRIGHT_CORNERS, inside, 1, 0, line, dx, dy)
        _split_samples(dx, dy, split)
        _sum_regions(split, weights, total, out[k])


@njit(cache=True, nogil=True)
def describe_oriented(integral, keypoints, weights, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 128) for keypoints (n, 3) of u, v, scale, the square turned to each one's own orientation.

    Wavelets are taken on a lattice along the image axes, one per s, and interpolated at the turned samples.
    """
    lattice, line, room = (
        lattice_room(TURNED_CORNERS),
        lattice_room(TURNED_CORNERS),
        row_room(integral.shape[1], TURNED_CORNERS),
    )
    dx, dy = np.empty(_NODES * STRIDE, np.float32), np.empty(_NODES * STRIDE, np.float32)
    nodes, samples = np.empty(2 * _NODES * STRIDE, np.float32), _sample_room()
    split, total = np.empty((SAMPLES, _ROW), np.float32), np.empty((2, _ROW), np.float32)
    for k in range(keypoints.shape[0]):
        inside = read_lattice(integral, keypoints[k], TURNED_CORNERS, lattice, room)
        angle = _dominant_direction(lattice, inside, line)
        haar_wavelets(lattice, TURNED_CORNERS, inside, 1, 0, line, dx, dy)
        _turned_samples(dx, dy, np.float32(np.cos(angle)), np.float32(np.sin(angle)), nodes, samples, split)
        _sum_regions(split, weights, total, out[k])


@njit(cache=True, nogil=True)
def orientation(integral, keypoint):  # type: ignore[no-untyped-def]
    """Dominant direction (rad) of the image around a keypoint (u, v, scale)."""
    lattice = lattice_room(TURNED_CORNERS)
    inside = read_lattice(integral, keypoint, TURNED_CORNERS, lattice, row_room(integral.shape[1], TURNED_CORNERS))
    return _dominant_direction(lattice, inside, lattice_room(TURNED_CORNERS))


@njit(cache=True, nogil=True)
def _dominant_direction(lattice, inside, line):  # type: ignore[no-untyped-def]
    """Direction of the largest sum of wavelets of size 4s, their own directions within 60 degrees."""
    dx, dy = np.empty(_SIDE * STRIDE, np.float32), np.empty(_SIDE * STRIDE, np.float32)
    haar_wavelets(lattice, TURNED_CORNERS, inside, 2, _FIRST, line, dx, dy)
    x, y = np.empty(len(_DISC), np.float32), np.empty(len(_DISC), np.float32)
    for k in range(len(_DISC)):
        x[k], y[k] = dx[_DISC[k]], dy[_DISC[k]]
    index = _directions(x, y)
    bins = np.zeros((DIRECTIONS + _WINDOW, 2))
    for k in range(len(_DISC)):
        bins[index[k], 0] += _DISC_WEIGHTS[k] * np.float64(x[k])
        bins[index[k], 1] += _DISC_WEIGHTS[k] * np.float64(y[k])
    for k in range(_WINDOW):
        bins[DIRECTIONS + k, 0], bins[DIRECTIONS + k, 1] = bins[k, 0], bins[k, 1]
    best, best_x, best_y = -1.0, 1.0, 0.0
    for start in range(DIRECTIONS):
        sum_x, sum_y = 0.0, 0.0
        for i in range(start, start + _WINDOW):
            sum_x += bins[i, 0]
            sum_y += bins[i, 1]
        if sum_x * sum_x + sum_y * sum_y > best:
            best, best_x, best_y = sum_x * sum_x + sum_y * sum_y, sum_x, sum_y
    return np.arctan2(best_y, best_x)


@njit(cache=True, nogil=True)
def _directions(x, y):  # type: ignore[no-untyped-def]
    """Sector of each vector (n,), one of ``DIRECTIONS`` counted from the negative x axis.

    By comparing with the tangents of their borders: a fifth of the time of as many arcs.
    """
    index = np.empty(len(x), np.int32)
    rising, running = np.empty_like(x), np.empty_like(x)
    for k in range(len(x)):
        left = x[k] < 0.0 or (x[k] == 0.0 and y[k] > 0.0)
        down = y[k] < 0.0 or (y[k] == 0.0 and x[k] < 0.0)
        flat, steep = abs(x[k]), abs(y[k])
        rising[k], running[k] = (steep, flat) if left == down else (flat, steep)
        index[k] = _PER_QUADRANT * ((0 if left else 1) if down else (3 if left else 2))
    for border in _BORDERS:
        for k in range(len(x)):
            index[k] += np.int32(rising[k] >= border * running[k])
    return index


@in_place()
def _turned_samples(dx, dy, cosine, sine, nodes, room, split):  # type: ignore[no-untyped-def]
    """Wavelets at the samples of a turned square, bilinear between nodes, along the square's axes and split by sign.

    ``nodes`` is room for (dx, dy) pairs of all nodes, ``room`` that of :func:`_sample_room`.
    """
    at, shares, x, y = room
    for k in range(len(dx)):
        nodes[2 * k], nodes[2 * k + 1] = dx[k], dy[k]
    middle = np.float32(0.5 * (_NODES - 1))
    for j in range(SAMPLES):
        across = _FIRST_SAMPLE + np.float32(j)
        _places(middle - sine * across, middle + cosine * across, cosine, sine, at, shares)
        _between_nodes(nodes, at, shares[0], shares[1], x, y)
        for i in range(SAMPLES):
            x[i], y[i] = cosine * x[i] + sine * y[i], cosine * y[i] - sine * x[i]
        split_by_sign(x, y, SAMPLES, split[j])


@njit(cache=True, nogil=True)
def _sample_room():  # type: ignore[no-untyped-def]
    """Room for a line of samples: the node before each, its shares of the next ones, its wavelets."""
    return (
        np.empty(SAMPLES, np.int32),
        np.empty((2, SAMPLES), np.float32),
        np.empty(SAMPLES, np.float32),
        np.empty(SAMPLES, np.float32),
    )


@in_place()
def _places(start_x, start_y, step_x, step_y, at, shares):  # type: ignore[no-untyped-def]
    """Fill ``at`` and ``shares`` for samples along a line through (start_x, start_y), one step apart."""
    for i in range(SAMPLES):
        along = _FIRST_SAMPLE + np.float32(i)
        x, y = start_x + step_x * along, start_y + step_y * along
        x0, y0 = np.int32(x), np.int32(y)
        shares[0, i], shares[1, i] = x - np.float32(x0), y - np.float32(y0)
        at[i] = 2 * (y0 * STRIDE + x0)


@in_place()
def _between_nodes(nodes, at, share_x, share_y, out_x, out_y):  # type: ignore[no-untyped-def]
    """Wavelets dx and dy of each sample of a line from those of the four nodes around it."""
    for i in range(SAMPLES):
        a = np.uintp(at[i])
        c, below = a + ONE + ONE, a + np.uintp(2 * STRIDE)
        d = below + ONE + ONE
        upper_x, lower_x = _lerp(nodes[a], nodes[c], share_x[i]), _lerp(nodes[below], nodes[d], share_x[i])
        upper_y = _lerp(nodes[a + ONE], nodes[c + ONE], share_x[i])
        lower_y = _lerp(nodes[below + ONE], nodes[d + ONE], share_x[i])
        out_x[i], out_y[i] = _lerp(upper_x, lower_x, share_y[i]), _lerp(upper_y, lower_y, share_y[i])


@in_place()
def _lerp(first, second, share):  # type: ignore[no-untyped-def]
    return first + share * (second - first)


@in_place()
def _split_samples(dx, dy, split):  # type: ignore[no-untyped-def]
    """The terms of all samples of a square along the axes of the image."""
    for j in range(SAMPLES):
        row = slice(j * STRIDE, j * STRIDE + SAMPLES)
        split_by_sign(dx[row], dy[row], SAMPLES, split[j])


@in_place()
def split_by_sign(dx, dy, count, out):  # type: ignore[no-untyped-def]
    """Write the eight terms of ``count`` samples, term after term (8 * count,).

    x and |x| where y is not negative, where it is, then y by the sign of x.
    """
    zero = np.float32(0.0)
    for i in range(count):
        x, y = dx[i], dy[i]
        positive_x = x if y >= zero else zero
        positive_y = y if x >= zero else zero
        out[i], out[count + i] = positive_x, abs(positive_x)
        out[2 * count + i], out[3 * count + i] = x - positive_x, abs(x - positive_x)
        out[4 * count + i], out[5 * count + i] = positive_y, abs(positive_y)
        out[6 * count + i], out[7 * count + i] = y - positive_y, abs(y - positive_y)


@in_place()
def _sum_regions(split, weights, row, out):  # type: ignore[no-untyped-def]
    """Weighted sums (128,) of the samples' terms (20, 8 * 20) over 4 x 4 subregions, scaled to unit length.

    ``row`` (2, 160) is room for one row of terms, term after term and sample after sample.
    """
    planes, samples = row[0], row[1]
    for region in range(4):
        planes[:] = np.float32(0.0)
        for j in range(SAMPLES):
            if weights[region, j] > 0.0:
                _add_row(split[j], weights[region, j], planes)
        for i in range(SAMPLES):
            for term in range(_TERMS):
                samples[_TERMS * i + term] = planes[SAMPLES * term + i]
        for column in range(4):
            at = (4 * region + column) * _TERMS
            _sum_samples(samples, weights[column], out[at : at + _TERMS])
    square = np.float32(0.0)
    for i in range(DIMENSION):
        square += out[i] * out[i]
    scale = np.float32(1.0) / max(np.sqrt(square), np.float32(1e-12))
    for i in range(DIMENSION):
        out[i] *= scale


@in_place()
def _add_row(values, weight, out):  # type: ignore[no-untyped-def]
    for i in range(_ROW):
        out[i] += weight * values[i]


@in_place()
def _sum_samples(row, weights, out):  # type: ignore[no-untyped-def]
    """Weighted sum of the samples of a row, term by term; the terms by name keep them in one vector register."""
    a = b = c = d = e = f = g = h = np.float32(0.0)
    for i in range(SAMPLES):
        w, at = weights[i], _TERMS * i
        if w > 0.0:
            a, b, c, d = a + w * row[at], b + w * row[at + 1], c + w * row[at + 2], d + w * row[at + 3]
            e, f, g, h = e + w * row[at + 4], f + w * row[at + 5], g + w * row[at + 6], h + w * row[at + 7]
    out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7] = a, b, c, d, e, f, g, h
