# SPDX-License-Identifier: Apache-2.0
"""Our planar filter and filterpy's over one drive: two implementations, one result."""

from __future__ import annotations

import numpy as np
import pytest

from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf
from slam_experiments.planar.filterpy_ekf import FilterpyPlanarEkf
from slam_simulation.planar import PlanarWorldConfig, simulate_planar

WORLD = PlanarWorldConfig(landmarks=15, samples=30)


@pytest.mark.parametrize("known", [True, False])
def test_both_filters_agree_over_a_drive(known):
    run = simulate_planar(WORLD, np.random.default_rng(3))
    config = PlanarConfig(sigma_range=WORLD.sigma_range, sigma_bearing=WORLD.sigma_bearing, error="standard")
    Q = np.diag(np.array([WORLD.sigma_step, WORLD.sigma_step, WORLD.sigma_turn]) ** 2)
    ours, theirs = (kind(config, run.poses[0], 1e-4 * np.eye(3)) for kind in (PlanarEkf, FilterpyPlanarEkf))
    for k, seen in enumerate(run.observations):
        reports = []
        for ekf in (ours, theirs):
            if k:
                ekf.predict(run.odometry[k - 1], Q)
            report, _ = ekf.process(np.column_stack([seen.ranges, seen.bearings]), seen.ids if known else None)
            reports.append((report.nis, report.dof))
        np.testing.assert_allclose(*reports, rtol=1e-6)
        np.testing.assert_allclose(ours.pose, theirs.pose, atol=1e-9)
    assert len(ours.landmarks) >= 12
    np.testing.assert_allclose(ours.landmarks, theirs.landmarks, atol=1e-9)
    np.testing.assert_allclose(ours.covariance.dense(), theirs.covariance.dense(), atol=1e-10)


def test_the_standard_error_state_is_taken_whatever_is_asked():
    assert FilterpyPlanarEkf(PlanarConfig(error="invariant"), np.zeros(3), np.eye(3)).config.error == "standard"
