# SPDX-License-Identifier: Apache-2.0
"""The survey's filters beside one EKF: conditionally independent submaps are exact, SEIF is near and bounded."""

from __future__ import annotations

import numpy as np
import pytest
from planar_monte_carlo import MOTION_COVARIANCE, drive, run_filter

from slam_experiments.planar.ekf import PlanarConfig, range_bearing
from slam_experiments.planar.independent import IndependentSubmaps
from slam_experiments.planar.seif import ACTIVE, PlanarSeif

EXACT = PlanarConfig(error="standard", sigma_range=1e-3, sigma_bearing=1e-3)
"""So little noise that it does not matter where models are linearised."""
SURE = 1e-12 * np.eye(3)


def run(technique, motions, seen, measured, covariance=MOTION_COVARIANCE):
    for k, z in enumerate(measured):
        if k:
            technique.predict(motions[k - 1], covariance)
        technique.process(z, seen[k])
    return technique


@pytest.fixture
def short_submaps(monkeypatch):
    monkeypatch.setattr("slam_experiments.planar.independent.LARGEST", 16)


@pytest.mark.usefixtures("short_submaps")
@pytest.mark.parametrize("rounds", [1, 2])
def test_independent_submaps_know_what_one_filter_knows(rng, rounds):
    covariance = 1e-4 * MOTION_COVARIANCE
    _, motions, _, seen, measured = drive(rng, EXACT, 60, 3.0, 60, rounds, covariance)
    ekf = run_filter(EXACT, motions, seen, measured, covariance)[0]
    submaps = run(IndependentSubmaps(EXACT, np.zeros(3), SURE), motions, seen, measured, covariance)
    assert len(submaps.maps) >= 4
    ids, points, blocks = submaps.landmarks()
    assert ids.tolist() == sorted(ekf.ids)
    order = np.argsort(ekf.ids)
    P = ekf.covariance.dense()
    own = np.array([P[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] for k in order])
    scale = np.sqrt(np.trace(own, axis1=1, axis2=2))
    assert (np.linalg.norm(points - ekf.landmarks[order], axis=1) < 0.05 * scale).all()
    np.testing.assert_allclose(blocks, own, rtol=0.01, atol=0.01 * scale.min() ** 2)
    np.testing.assert_allclose(submaps.pose, ekf.pose, atol=0.1 * np.sqrt(P[0, 0]))


@pytest.mark.usefixtures("short_submaps")
def test_what_is_learnt_later_moves_older_submaps(rng):
    _, motions, world, seen, measured = drive(rng, PlanarConfig(), 60, 3.0, 60)
    submaps = run(IndependentSubmaps(PlanarConfig(), np.zeros(3), SURE), motions, seen, measured)
    before = [m.mean.copy() for m in submaps.maps]
    ids, points, _ = submaps.landmarks()
    assert any(np.abs(m.mean - mean).max() > 1e-3 for m, mean in zip(submaps.maps[:-1], before, strict=False))
    assert np.linalg.norm(points - world[ids], axis=1).mean() < 0.1


def test_seif_is_one_filter_as_long_as_all_landmarks_are_active(rng):
    world = rng.uniform(-4.0, 4.0, (ACTIVE - 1, 2))
    config = PlanarConfig(error="standard", sigma_range=1e-3, sigma_bearing=1e-3)
    motions = [np.array([0.01, 0.002, 0.01]) + 1e-4 * rng.standard_normal(3) for _ in range(11)]
    truth = np.zeros(3)
    seen = [np.arange(len(world)) for _ in range(12)]
    noise = [1e-3, 1e-3]
    measured = [range_bearing(truth, world)[0] + noise * rng.standard_normal((len(world), 2)) for _ in range(12)]
    covariance = np.diag([0.05, 0.05, 0.05]) ** 2
    ekf = run_filter(config, motions, seen, measured, covariance)[0]
    seif = run(PlanarSeif(config, np.zeros(3), SURE), motions, seen, measured, covariance)
    np.testing.assert_allclose(seif.landmarks, ekf.landmarks, atol=2e-4)
    np.testing.assert_allclose(seif.pose, ekf.pose, atol=2e-4)
    H, _ = seif._local(range(len(world)))
    P = ekf.covariance.dense()
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(H))), np.sqrt(np.diag(P)), rtol=0.02)


def test_seif_bounds_its_links_and_still_maps(rng):
    config = PlanarConfig()
    truth, motions, world, seen, measured = drive(rng, config, 100, 3.0, 120, 2)
    seif = PlanarSeif(config, np.zeros(3), SURE)
    for k, z in enumerate(measured):
        if k:
            seif.predict(motions[k - 1], MOTION_COVARIANCE)
        seif.process(z, seen[k])
        assert len(seif._to_pose) <= ACTIVE
    ids = list(seif.ids)
    assert len(ids) > 40
    links = np.mean([len(links) for links in seif._links])
    assert links < 0.6 * len(ids)
    assert np.linalg.norm(truth[-1][:2] - seif.pose[:2]) < 0.3
    assert np.linalg.norm(seif.landmarks - world[ids], axis=1).mean() < 0.3


def test_cutting_links_leaves_the_mean_alone(rng):
    config = PlanarConfig()
    _, motions, _, seen, measured = drive(rng, config, 30, 6.0, 60)
    seif = run(PlanarSeif(config, np.zeros(3), SURE), motions, seen, measured)
    mean = seif.landmarks.copy(), seif.pose.copy(), [r.copy() for r in seif._r]
    extra = next(s for s in range(len(mean[0])) if s not in seif._to_pose)
    seif._to_pose[extra] = 1e-3 * np.ones((3, 2))
    seif._make_passive(set())
    assert len(seif._to_pose) == ACTIVE
    np.testing.assert_array_equal(seif.landmarks, mean[0])
    np.testing.assert_array_equal(seif.pose, mean[1])
    np.testing.assert_array_equal(np.array(seif._r), np.array(mean[2]))
