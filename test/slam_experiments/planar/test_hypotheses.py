# SPDX-License-Identifier: Apache-2.0
"""Several hypotheses over a planar drive: the same numbers as the filter's, and landmarks told apart by later sight."""

from __future__ import annotations

import numpy as np
import pytest

from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf, range_bearing
from slam_experiments.planar.hypotheses import HypothesesConfig, PlanarHypotheses
from slam_simulation.planar import PlanarWorldConfig, simulate_planar


def test_a_hypothesis_is_the_filter_with_its_names():
    world = PlanarWorldConfig(samples=30, landmarks=15)
    run = simulate_planar(world, np.random.default_rng(1))
    config = PlanarConfig(sigma_range=world.sigma_range, sigma_bearing=world.sigma_bearing)
    Q = np.diag(np.array([world.sigma_step, world.sigma_step, world.sigma_turn]) ** 2)
    many = PlanarHypotheses(config, run.poses[0], 10.0, HypothesesConfig(most=1))
    for k, seen in enumerate(run.observations):
        if k:
            many.predict(run.odometry[k - 1], Q)
        many.process(np.column_stack([seen.ranges, seen.bearings]))
    names = iter(many.best())
    ekf = PlanarEkf(config, run.poses[0], 1e-12 * np.eye(3))
    for k, seen in enumerate(run.observations):
        if k:
            ekf.predict(run.odometry[k - 1], Q)
        for z in np.column_stack([seen.ranges, seen.bearings]):
            ekf.process(z[None], np.array([next(names)]))
    mean, covariance = many.most_probable
    np.testing.assert_allclose(mean, [*ekf.pose, *ekf.landmarks.ravel()], atol=1e-9)
    np.testing.assert_allclose(covariance, ekf.covariance.dense(), atol=1e-10)


@pytest.mark.parametrize("most", [1, 20])
def test_what_is_seen_later_tells_neighbours_apart(most):
    """After a blind turn the next sighting fits the wrong one of two neighbours better; those after it do not."""
    config = PlanarConfig(sigma_range=0.05, sigma_bearing=0.01)
    landmarks = np.array([[4.0, 0.0], [4.0, 0.5], [3.0, -2.0], [3.5, 2.5]])
    start, after = np.zeros(3), np.array([0.0, 0.0, 0.11])
    many = PlanarHypotheses(config, start, 10.0, HypothesesConfig(most=most))
    for _ in range(20):
        many.process(range_bearing(start, landmarks)[0])
        many.predict(np.zeros(3), 1e-12 * np.eye(3))
    many.predict(np.zeros(3), np.diag([1e-6, 1e-6, 0.1**2]))
    many.process(range_bearing(after, landmarks[1:2])[0])
    for k in (2, 3, 0, 1):
        many.process(range_bearing(after, landmarks[k : k + 1])[0])
    found = many.best()[-5:].tolist()
    assert (found == [1, 2, 3, 0, 1]) == (most > 1)
