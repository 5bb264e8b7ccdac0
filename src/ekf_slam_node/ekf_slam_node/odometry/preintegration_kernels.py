# SPDX-License-Identifier: Apache-2.0
"""Compiled kernel that sums up the readings of an IMU between two stamps: one call for what took some forty arrays.

See :mod:`ekf_slam_node.odometry.preintegration` for what is summed up.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.linear_algebra.small_kernels import rotate_columns
from slam_core.runtime.in_place import in_place

HELD_NS = 1_500_000
"""The first and the last reading hold for twice as long beyond them."""


@njit(cache=True, nogil=True, error_model="numpy")
def preintegrated(stamps, rates, forces, span, biases, noise, longest_step, R, v, p, J, covariance):  # type: ignore[no-untyped-def]
    """Fill R (3, 3), v and p (3,), J (9, 6) and covariance (9, 9) of a preintegral; returns the mean size of the force.

    ``stamps`` (m,) ns, rising, of ``rates`` and ``forces`` (m, 3); ``span`` (2,) ns from start to end; ``biases`` (6,);
    ``noise`` (4,): gyro, accelerometer, and unknown turn and force, which hold where readings are further apart than
    ``longest_step`` s or missing. Readings are interpolated at the middle of each interval and held through it.
    """
    first = np.searchsorted(stamps, span[0] + 1)
    last = max(np.searchsorted(stamps, span[1]), first)
    n = last - first + 1
    steps, silent = np.empty(n), np.empty(n, np.bool_)
    velocities, places = np.empty((n, 3)), np.empty((n, 3))
    reading, force, turned = np.empty(6), np.empty(3), np.empty((3, 3))
    back, middle = np.eye(3), np.empty((3, 3))  # transposed rotations: at the interval's start and at its middle
    v[:], p[:], J[:] = 0.0, 0.0, 0.0
    size = 0.0
    for k in range(n):
        begin = span[0] if k == 0 else stamps[first + k - 1]
        end = span[1] if k == n - 1 else stamps[first + k]
        dt = 1e-9 * (end - begin)
        silent[k] = _interpolate(stamps, rates, forces, begin, end, reading) or dt > longest_step
        size += np.sqrt(reading[3] ** 2 + reading[4] ** 2 + reading[5] ** 2) / n
        for i in range(6):
            reading[i] -= biases[i]
        middle[:] = back
        rotate_columns(middle, -0.5 * dt * reading[0], -0.5 * dt * reading[1], -0.5 * dt * reading[2], 3)
        rotate_columns(back, -dt * reading[0], -dt * reading[1], -dt * reading[2], 3)
        for i in range(3):
            force[i] = middle[0, i] * reading[3] + middle[1, i] * reading[4] + middle[2, i] * reading[5]
        _add_to_jacobian(middle, force, dt, turned, J)
        steps[k] = dt
        for i in range(3):
            p[i] += (v[i] + 0.5 * force[i] * dt) * dt
            v[i] += force[i] * dt
            velocities[k, i], places[k, i] = v[i], p[i]
    for i in range(3):
        for j in range(3):
            R[i, j] = back[j, i]
    _sum_noise(velocities, places, steps, silent, noise, covariance)
    return size


@in_place()
def _interpolate(stamps, rates, forces, begin, end, reading):  # type: ignore[no-untyped-def]
    """Fill the reading (6,) at the middle of an interval; True if that lies far outside the readings.

    There the nearest reading is taken.
    """
    middle, last = 0.5 * (end - begin), len(stamps) - 1
    after = 0
    while after <= last and stamps[after] - begin <= middle:
        after += 1
    low, high = max(after - 1, 0), min(after, last)
    share = 0.0
    if high > low:
        share = (middle - (stamps[low] - begin)) / (stamps[high] - stamps[low])
    for i in range(3):
        reading[i] = rates[low, i] + share * (rates[high, i] - rates[low, i])
        reading[3 + i] = forces[low, i] + share * (forces[high, i] - forces[low, i])
    return max(stamps[0] - begin - middle, middle - (stamps[last] - begin)) > HELD_NS


@in_place()
def _add_to_jacobian(middle, force, dt, turned, J):  # type: ignore[no-untyped-def]
    """Add an interval to J (9, 6), turns taken as small within it; ``turned`` (3, 3) is for its own use."""
    x, y, z = force[0], force[1], force[2]
    for i in range(3):
        for j in range(3):
            # What the turn has gone wrong by at the middle of the interval turns the force of it.
            turned[i, j] = J[i, j] - 0.5 * dt * middle[j, i]
            J[i, j] -= dt * middle[j, i]
    for j in range(6):
        for i in range(3):
            if j >= 3:
                rate = -middle[j - 3, i]
            elif i == 0:
                rate = z * turned[1, j] - y * turned[2, j]
            elif i == 1:
                rate = x * turned[2, j] - z * turned[0, j]
            else:
                rate = y * turned[0, j] - x * turned[1, j]
            J[6 + i, j] += (J[3 + i, j] + 0.5 * dt * rate) * dt
            J[3 + i, j] += dt * rate


@in_place()
def _sum_noise(velocities, places, steps, silent, noise, C):  # type: ignore[no-untyped-def]
    """Fill the covariance C (9, 9): each interval's noise is fresh and acts on all that follows it."""
    n = len(steps)
    C[:] = 0.0
    until = 0.0
    for k in range(n - 1, -1, -1):
        dt = steps[k]
        gyro = (noise[2] * dt) ** 2 if silent[k] else noise[0] ** 2 * dt
        force = (noise[3] * dt) ** 2 if silent[k] else noise[1] ** 2 * dt
        u, w = velocities[k], places[k]
        ax, ay, az = velocities[n - 1, 0] - u[0], velocities[n - 1, 1] - u[1], velocities[n - 1, 2] - u[2]
        bx, by = places[n - 1, 0] - w[0] - u[0] * until, places[n - 1, 1] - w[1] - u[1] * until
        bz = places[n - 1, 2] - w[2] - u[2] * until
        reach = until + 0.5 * dt
        _add_turn(C, 3, gyro, ax, ay, az)
        _add_turn(C, 6, gyro, bx, by, bz)
        _add_product(C, 3, 3, gyro, ax, ay, az, ax, ay, az)
        _add_product(C, 6, 3, gyro, bx, by, bz, ax, ay, az)
        _add_product(C, 6, 6, gyro, bx, by, bz, bx, by, bz)
        for i in range(3):
            C[i, i] += gyro
            C[3 + i, 3 + i] += force
            C[6 + i, 3 + i] += reach * force
            C[6 + i, 6 + i] += reach * reach * force
        until += dt
    for i in range(9):
        for j in range(i):
            C[j, i] = C[i, j]


@in_place()
def _add_turn(C, row, gyro, x, y, z):  # type: ignore[no-untyped-def]
    """``C[row:row + 3, :3] -= gyro [v]x`` for v = (x, y, z)."""
    C[row, 1] += gyro * z
    C[row, 2] -= gyro * y
    C[row + 1, 0] -= gyro * z
    C[row + 1, 2] += gyro * x
    C[row + 2, 0] += gyro * y
    C[row + 2, 1] -= gyro * x


@in_place()
def _add_product(C, row, column, gyro, ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    """``C[row:row + 3, column:column + 3] += gyro [a]x [b]x^T``, which is ``(a b) I - b a^T``."""
    dot = ax * bx + ay * by + az * bz
    C[row, column] += gyro * (dot - bx * ax)
    C[row, column + 1] -= gyro * bx * ay
    C[row, column + 2] -= gyro * bx * az
    C[row + 1, column] -= gyro * by * ax
    C[row + 1, column + 1] += gyro * (dot - by * ay)
    C[row + 1, column + 2] -= gyro * by * az
    C[row + 2, column] -= gyro * bz * ax
    C[row + 2, column + 1] -= gyro * bz * ay
    C[row + 2, column + 2] += gyro * (dot - bz * az)
