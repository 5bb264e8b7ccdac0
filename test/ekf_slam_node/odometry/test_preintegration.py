# SPDX-License-Identifier: Apache-2.0
"""The compiled preintegral equals the same sums over NumPy's arrays, with gaps and silence at either end."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.odometry.preintegration import ImuNoise, ImuReadings, Preintegral
from ekf_slam_node.odometry.preintegration_kernels import HELD_NS
from slam_core.geometry import FloatArray, skew, so3_exp
from slam_core.types import LONGEST_IMU_STEP_S, ImuSample

NOISE = ImuNoise(1e-3, 2e-2, 0.7, 3.0)


def samples(rng: np.random.Generator, stamps: list[int]) -> list[ImuSample]:
    return [ImuSample(s, rng.normal(0.0, 2.0, 3), rng.normal(0.0, 9.0, 3)) for s in stamps]


@pytest.mark.parametrize(
    ("stamps_ms", "span_ms"),
    [
        (list(range(0, 130, 5)), (2, 101)),
        (list(range(0, 130, 5)), (0, 100)),
        ([0, 7, 11, 60, 64, 90], (3, 95)),
        ([20, 30, 40, 50, 60, 70], (0, 100)),
        ([0, 100], (40, 60)),
    ],
    ids=["between readings", "at readings", "a gap", "late and early", "inside one step"],
)
def test_sums_are_those_of_arrays(stamps_ms: list[int], span_ms: tuple[int, int]) -> None:
    rng = np.random.default_rng(len(stamps_ms))
    start = 1_700_000_000_000_000_000
    taken = samples(rng, [start + 1_000_000 * ms for ms in stamps_ms])
    biases = rng.normal(0.0, 0.1, 6)
    readings = ImuReadings()
    for sample in taken:
        assert readings.add(sample)
    begin, end = (start + 1_000_000 * ms for ms in span_ms)
    found = readings.integrate(begin, end, biases, NOISE)
    assert found is not None
    expected = by_arrays(taken, begin, end, biases)
    for name in ("dt", "R", "v", "p", "covariance", "force", "reading"):
        # Stamps of this size are whole microseconds to a float, which the arrays have subtracted first.
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(found.J[:, :6], expected.J, rtol=1e-9, atol=1e-12)


def by_arrays(taken: list[ImuSample], start_ns: int, end_ns: int, biases: FloatArray) -> Preintegral:
    stamps = np.array([sample.stamp_ns - start_ns for sample in taken])
    inside = stamps[(stamps > 0) & (stamps < end_ns - start_ns)]
    edges = np.concatenate([[0], inside, [end_ns - start_ns]])
    dt, middle = 1e-9 * np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    columns = [*np.array([s.angular_velocity for s in taken]).T, *np.array([s.linear_acceleration for s in taken]).T]
    readings = np.column_stack([np.interp(middle, stamps, column) for column in columns])
    silent = (dt > LONGEST_IMU_STEP_S) | (np.maximum(stamps[0] - middle, middle - stamps[-1]) > HELD_NS)
    size = float(np.linalg.norm(readings[:, 3:], axis=1).mean())
    readings = readings - biases
    turns, half = so3_exp(readings[:, :3] * dt[:, None]), so3_exp(0.5 * readings[:, :3] * dt[:, None])
    R, before = np.eye(3), np.empty_like(turns)
    for k, turn in enumerate(turns):
        before[k], R = R, R @ turn
    rotation, step = before @ half, dt[:, None]
    force = np.einsum("nij,nj->ni", rotation, readings[:, 3:])
    v = np.cumsum(force * step, axis=0)
    p = np.cumsum((v - force * step) * step + 0.5 * force * step**2, axis=0)
    J, C = bias_jacobian(rotation, force, dt), noise_covariance(v, p, dt, silent)
    return Preintegral(float(dt.sum()), R, v[-1], p[-1], J, np.zeros((2, 3)), C, v[-1] / dt.sum(), size)


def bias_jacobian(rotation: FloatArray, force: FloatArray, dt: FloatArray) -> FloatArray:
    width = dt[:, None, None]
    turn = -np.cumsum(rotation * width, axis=0)
    rates = np.concatenate([-skew(force) @ (turn + 0.5 * rotation * width), -rotation], axis=2)
    v = np.cumsum(rates * width, axis=0)
    J = np.zeros((9, 6))
    J[:3, :3], J[3:6] = turn[-1], v[-1]
    J[6:] = np.sum((v - rates * width) * width + 0.5 * rates * width**2, axis=0)
    return J


def noise_covariance(v: FloatArray, p: FloatArray, dt: FloatArray, silent: np.ndarray) -> FloatArray:
    gyro = np.where(silent, (NOISE.unknown_turn * dt) ** 2, NOISE.gyro**2 * dt)
    force = np.where(silent, (NOISE.unknown_force * dt) ** 2, NOISE.accelerometer**2 * dt)
    until = dt.sum() - np.cumsum(dt)
    of_turn, of_force = np.zeros((len(dt), 9, 3)), np.zeros((len(dt), 9, 3))
    of_turn[:, :3], of_force[:, 3:6] = np.eye(3), np.eye(3)
    of_turn[:, 3:6] = -skew(v[-1] - v)
    of_turn[:, 6:] = -skew(p[-1] - p - v * until[:, None])
    of_force[:, 6:] = np.eye(3) * (until + 0.5 * dt)[:, None, None]
    parts = [np.einsum("nij,n,nkj->ik", G, q, G) for G, q in ((of_turn, gyro), (of_force, force))]
    return np.asarray(parts[0] + parts[1])
