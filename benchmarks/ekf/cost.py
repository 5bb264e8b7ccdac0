# SPDX-License-Identifier: Apache-2.0
"""Milliseconds per update against the number of landmarks, beside what the arithmetic alone takes on this machine.

    python benchmarks/ekf/cost.py

The floor is the time of its three matrix products and triangular solves (potrf, trsm, syrk of the sizes at hand),
measured here with the same BLAS on exactly sized matrices.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy.linalg import blas, lapack

from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.models import CORE_DIM, observe
from slam_core.camera import Camera
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform, transform_points

CAMERA = Camera(640, 480, 283.0, 283.0, 320.0, 240.0)
T_RIG_OPTICAL = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))


def median_ms(work: Callable[[], object], repeats: int = 15) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def full_filter(landmarks: int, rng: np.random.Generator) -> Ekf:
    """A filter with so many landmarks in view and a dense covariance."""
    core = np.diag([1e-3] * 6 + [1e-2] * 6)
    ekf = Ekf(np.zeros(6), core)
    optical = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 6.0], (landmarks, 3))
    ekf.augment(transform_points(T_RIG_OPTICAL, optical), np.tile(1e-2 * np.eye(3), (landmarks, 1, 1)))
    return ekf


def update_ms(ekf: Ekf, observations: int, rng: np.random.Generator) -> float:
    slots = rng.choice(len(ekf.landmarks), observations, replace=False)
    variance = np.tile([1.0, 1.0, 1e-4], (observations, 1))

    def work() -> None:
        seen = observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks[slots], CAMERA)
        ekf.update(seen.z, variance, seen, slots)

    return median_ms(work)


def floor_ms(size: int, rows: int, rng: np.random.Generator) -> float:
    """Potrf of (rows, rows), trsm of (size, rows), syrk to (size, size)."""
    A = rng.standard_normal((rows, rows))
    S = np.asfortranarray(A @ A.T + rows * np.eye(rows))
    W: FloatArray = np.asfortranarray(rng.standard_normal((size, rows)))
    P = np.zeros((size, size), order="F")

    def work() -> None:
        L, _ = lapack.dpotrf(S, lower=1)
        solved = blas.dtrsm(1.0, L, W, side=1, lower=1, trans_a=1)
        blas.dsyrk(-1e-6, solved, beta=1.0, c=P, lower=1, overwrite_c=1)

    return median_ms(work)


def main() -> None:
    rng = np.random.default_rng(0)
    print(f"{'landmarks':>10} {'observed':>9} {'update ms':>10} {'floor ms':>9} {'ratio':>6}")
    for landmarks, observations in (
        (20, 20),
        (50, 50),
        (100, 50),
        (200, 50),
        (350, 50),
        (350, 120),
        (600, 50),
        (818, 50),
    ):
        ekf = full_filter(landmarks, rng)
        update_ms(ekf, observations, rng)
        took = update_ms(ekf, observations, rng)
        floor = floor_ms(CORE_DIM + 3 * landmarks, 3 * observations, rng)
        print(f"{landmarks:10d} {observations:9d} {took:10.2f} {floor:9.2f} {took / floor:6.2f}", flush=True)


if __name__ == "__main__":
    main()
