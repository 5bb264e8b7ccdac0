"""Compiled kernels of the SURF-128 descriptor (Bay et al. 2008, section 4).

A square of 20 x 20 samples, one per scale unit s, is covered by Haar wavelets of size 2s. Each of 4 x 4 subregions sums
dx and |dx| separately by the sign of dy, and dy and |dy| by the sign of dx: 8 numbers each, 128 in all, normalised.
The integral image is read with bilinear interpolation, which makes every box sum exact for any scale and position;
upright, all wavelets share one lattice of 22 x 22 corners.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.types import Float32Array

SAMPLES = 20
CORNERS = SAMPLES + 2
TURNED_CORNERS = 31
"""Corners along each side that a square needs however it is turned."""
DIRECTIONS = 36
DIMENSION = 128
WEIGHT_SIGMA = 5.0
"""Width of the Gaussian over the samples, in scale units. The paper has 3.3; on EuRoC and KITTI pairs 5 raised the
precision of
mutual matches from 0.90 to 0.91 and from 0.82 to 0.85 with 5 % more of them."""


def region_weights() -> Float32Array:
    """Weight of every sample of one axis in each of the four subregions, shape (4, 20): Gaussian, with soft borders.

    A sample counts for the two subregions beside it in proportion to its distance from their centres, so that a small
    shift does not move it from one number to another.
    """
    position = np.arange(SAMPLES) - (SAMPLES - 1) / 2.0
    centres = (np.arange(4) - 1.5) * 5.0
    overlap = np.clip(1.0 - np.abs(position[None, :] - centres[:, None]) / 5.0, 0.0, 1.0)
    return np.asarray(overlap * np.exp(-0.5 * (position / WEIGHT_SIGMA) ** 2), np.float32)


@njit(cache=True, nogil=True)
def describe_upright(integral, keypoints, weights, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 128) for keypoints (n, 3) of u, v, scale with wavelets along the axes of the image."""
    lattice = np.empty((CORNERS, CORNERS))
    dx = np.empty((SAMPLES, SAMPLES))
    dy = np.empty((SAMPLES, SAMPLES))
    for k in range(keypoints.shape[0]):
        inside = _read_lattice(integral, keypoints[k], lattice)
        _wavelets(lattice, inside, 1, dx, dy)
        _sum_regions(dx, dy, weights, out[k])


@njit(cache=True, nogil=True)
def describe_oriented(integral, keypoints, weights, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 128) for keypoints (n, 3) of u, v, scale, the square turned to each one's own orientation.

    Wavelets are taken on a lattice along the image axes, one per s, and interpolated at the turned samples.
    """
    lattice = np.empty((TURNED_CORNERS, TURNED_CORNERS))
    nodes = TURNED_CORNERS - 2
    node_dx, node_dy = np.empty((nodes, nodes)), np.empty((nodes, nodes))
    dx, dy = np.empty((SAMPLES, SAMPLES)), np.empty((SAMPLES, SAMPLES))
    for k in range(keypoints.shape[0]):
        inside = _read_lattice(integral, keypoints[k], lattice)
        _wavelets(lattice, inside, 1, node_dx, node_dy)
        angle = _dominant_direction(lattice, inside)
        _turned_samples(node_dx, node_dy, np.cos(angle), np.sin(angle), dx, dy)
        _sum_regions(dx, dy, weights, out[k])


@njit(cache=True, nogil=True)
def orientation(integral, keypoint):  # type: ignore[no-untyped-def]
    """Dominant direction (rad) of the image around a keypoint (u, v, scale)."""
    lattice = np.empty((TURNED_CORNERS, TURNED_CORNERS))
    inside = _read_lattice(integral, keypoint, lattice)
    return _dominant_direction(lattice, inside)


@njit(cache=True, nogil=True)
def _dominant_direction(lattice, inside):  # type: ignore[no-untyped-def]
    """Integral image at corners one s apart around the keypoint; first_x, last_x, first_y, last_y of those in the
    image.
    """
    nodes = TURNED_CORNERS - 4
    dx, dy = np.empty((nodes, nodes)), np.empty((nodes, nodes))
    _wavelets(lattice, inside, 2, dx, dy)
    bins = np.zeros((DIRECTIONS, 2))
    middle = nodes // 2
    for j in range(-6, 7):
        for i in range(-6, 7):
            if i * i + j * j <= 36:
                weight = np.exp(-(i * i + j * j) / 8.0)
                x, y = dx[middle + j, middle + i], dy[middle + j, middle + i]
                index = int((np.arctan2(y, x) + np.pi) * (DIRECTIONS / (2.0 * np.pi))) % DIRECTIONS
                bins[index, 0] += weight * x
                bins[index, 1] += weight * y
    best, direction = -1.0, 0.0
    for start in range(DIRECTIONS):
        x, y = 0.0, 0.0
        for i in range(DIRECTIONS // 6):
            x += bins[(start + i) % DIRECTIONS, 0]
            y += bins[(start + i) % DIRECTIONS, 1]
        if x * x + y * y > best:
            best, direction = x * x + y * y, np.arctan2(y, x)
    return direction


@njit(cache=True, nogil=True)
def _read_lattice(integral, keypoint, lattice):  # type: ignore[no-untyped-def]
    """Integral image at corners one s apart around the keypoint; returns first_x, last_x, first_y, last_y in the
    image.
    """
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    corners = lattice.shape[0]
    scale = keypoint[2]
    reach = 0.5 * (corners - 1) * scale
    left, top = keypoint[0] + 0.5 - reach, keypoint[1] + 0.5 - reach
    first_x, last_x = max(0, int(np.ceil(-left / scale))), min(corners - 1, int(np.floor((width - left) / scale)))
    first_y, last_y = max(0, int(np.ceil(-top / scale))), min(corners - 1, int(np.floor((height - top) / scale)))
    for j in range(first_y, last_y + 1):
        y = top + j * scale
        y0 = min(max(int(y), 0), height - 1)
        fy = y - y0
        above, below = integral[y0], integral[y0 + 1]
        for i in range(first_x, last_x + 1):
            x = left + i * scale
            x0 = min(max(int(x), 0), width - 1)
            fx = x - x0
            upper = above[x0] + fx * (above[x0 + 1] - above[x0])
            lower = below[x0] + fx * (below[x0 + 1] - below[x0])
            lattice[j, i] = upper + fy * (lower - upper)
    return first_x, last_x, first_y, last_y


@njit(cache=True, nogil=True)
def _wavelets(lattice, inside, half, dx, dy):  # type: ignore[no-untyped-def]
    """Haar responses of size ``2 half`` s around every corner that has such neighbours; zero across the border."""
    first_x, last_x, first_y, last_y = inside
    dx[:], dy[:] = 0.0, 0.0
    for j in range(first_y, last_y - 2 * half + 1):
        above, centre, below = lattice[j], lattice[j + half], lattice[j + 2 * half]
        for i in range(first_x, last_x - 2 * half + 1):
            m, e = i + half, i + 2 * half
            dx[j, i] = below[i] - above[i] - 2.0 * (below[m] - above[m]) + below[e] - above[e]
            dy[j, i] = below[e] - below[i] - 2.0 * (centre[e] - centre[i]) + above[e] - above[i]


@njit(cache=True, nogil=True)
def _turned_samples(node_dx, node_dy, cosine, sine, dx, dy):  # type: ignore[no-untyped-def]
    """Wavelets at the samples of a turned square, by bilinear interpolation between nodes, along the square's axes."""
    middle = 0.5 * (node_dx.shape[0] - 1)
    for j in range(SAMPLES):
        for i in range(SAMPLES):
            along, across = i - 9.5, j - 9.5
            x, y = middle + cosine * along - sine * across, middle + sine * along + cosine * across
            x0, y0 = int(x), int(y)
            fx, fy = x - x0, y - y0
            w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
            a = w00 * node_dx[y0, x0] + w01 * node_dx[y0, x0 + 1]
            a += w10 * node_dx[y0 + 1, x0] + w11 * node_dx[y0 + 1, x0 + 1]
            b = w00 * node_dy[y0, x0] + w01 * node_dy[y0, x0 + 1]
            b += w10 * node_dy[y0 + 1, x0] + w11 * node_dy[y0 + 1, x0 + 1]
            dx[j, i] = cosine * a + sine * b
            dy[j, i] = cosine * b - sine * a


@njit(cache=True, nogil=True)
def _sum_regions(dx, dy, weights, out):  # type: ignore[no-untyped-def]
    """Weighted sums of the 4 x 4 subregions, split by the other component's sign, scaled to unit length."""
    sums = np.zeros((4, 4, 8))
    line = np.empty((4, 8))
    for j in range(SAMPLES):
        line[:] = 0.0
        for i in range(SAMPLES):
            x, y = dx[j, i], dy[j, i]
            at_x = 0 if y >= 0.0 else 2
            at_y = 4 if x >= 0.0 else 6
            for column in range(4):
                weight = weights[column, i]
                if weight > 0.0:
                    line[column, at_x] += weight * x
                    line[column, at_x + 1] += weight * abs(x)
                    line[column, at_y] += weight * y
                    line[column, at_y + 1] += weight * abs(y)
        for row in range(4):
            if weights[row, j] > 0.0:
                for column in range(4):
                    for i in range(8):
                        sums[row, column, i] += weights[row, j] * line[column, i]
    flat = sums.ravel()
    norm = np.sqrt(np.sum(flat * flat))
    for i in range(DIMENSION):
        out[i] = flat[i] / max(norm, 1e-12)
