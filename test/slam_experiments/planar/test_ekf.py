# SPDX-License-Identifier: Apache-2.0
"""The 2D twin: models, consistency, association known and unknown, JCBB, and smoothing beside filtering."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from planar_monte_carlo import MOTION_COVARIANCE, drive, planar_nees, run_filter

from ekf_slam_node.association.jcbb import JointPrediction, jcbb
from slam_core.evaluation import anees_bounds
from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf, move, place, range_bearing, turn, wrap
from slam_experiments.planar.sam import PlanarGraph, PlanarMap, cost, pose_covariances, smooth

STEP = 1e-6


def test_jacobians(rng: np.random.Generator) -> None:
    pose, motion, z = rng.standard_normal(3), rng.standard_normal(3), np.array([2.0, 0.7])
    landmark = np.array([[1.0, 2.0]])

    def numeric(function, x):  # type: ignore[no-untyped-def]
        return np.stack([(function(x + d) - function(x - d)) / (2 * STEP) for d in STEP * np.eye(len(x))], axis=-1)

    _, J_pose, J_motion = move(pose, motion)
    np.testing.assert_allclose(J_pose, numeric(lambda p: move(p, motion)[0], pose), atol=1e-7)
    np.testing.assert_allclose(J_motion, numeric(lambda m: move(pose, m)[0], motion), atol=1e-7)
    _, J_pose, J_landmark = range_bearing(pose, landmark)
    np.testing.assert_allclose(J_pose[0], numeric(lambda p: range_bearing(p, landmark)[0][0], pose), atol=1e-7)
    np.testing.assert_allclose(
        J_landmark[0], numeric(lambda m: range_bearing(pose, m[None])[0][0], landmark[0]), atol=1e-7
    )
    _, J_pose, J_z = place(pose, z)
    np.testing.assert_allclose(J_pose, numeric(lambda p: place(p, z)[0], pose), atol=1e-7)
    np.testing.assert_allclose(J_z, numeric(lambda m: place(pose, m)[0], z), atol=1e-7)


def test_errors_are_as_large_as_claimed() -> None:
    pose, landmarks, nis = planar_nees(50, "invariant")
    low, high = anees_bounds(3, 50)
    assert low < pose < high
    assert 0.9 < landmarks < 1.1
    assert 0.97 < nis < 1.03


def test_one_filter_over_rough_rounds_is_honest_only_in_the_invariant_error() -> None:
    _, invariant, _ = planar_nees(10, "invariant", rough=True)
    _, standard, _ = planar_nees(10, "standard", rough=True)
    assert invariant < 1.5
    assert standard > 2.0


@pytest.mark.parametrize("method", ["mahalanobis", "jcbb", "ccda"])
def test_unknown_association_closes_the_loop(rng: np.random.Generator, method: str) -> None:
    config = PlanarConfig(method=method)
    truth, motions, _, seen, measured = drive(rng, config)
    ekf, poses, slots, _, _ = run_filter(config, motions, None, measured)
    owner: dict[int, int] = {}
    pairs = [(s, i) for used, ids in zip(slots, seen, strict=True) for s, i in zip(used, ids, strict=True) if s >= 0]
    wrong = sum(owner.setdefault(int(s), int(i)) != i for s, i in pairs)
    assert wrong <= 0.01 * len(pairs)
    assert len(ekf.landmarks) <= 1.2 * len(np.unique(np.concatenate(seen)))
    assert np.linalg.norm(truth[-1][:2] - poses[-1][:2]) < 0.3


def test_joint_compatibility_undoes_what_nearest_neighbour_gets_wrong() -> None:
    """A pose error shifts everything by almost the spacing of the landmarks: singly plausible, jointly not."""
    landmarks = np.array([[0.0], [1.0], [2.2]])
    shift = 0.8
    shared = np.full((3, 3), 1.0) + 1e-4 * np.eye(3)
    measured = landmarks[:2] + shift
    noise = np.full((2, 1, 1), 1e-3)
    prediction = JointPrediction(landmarks, shared)
    nearest = np.abs(measured - landmarks.T).argmin(axis=1)
    assert nearest.tolist() == [1, 2]
    assert jcbb(measured, noise, prediction).tolist() == [0, 1]


def test_jcbb_leaves_out_what_fits_nothing() -> None:
    prediction = JointPrediction(np.array([[0.0, 0.0], [3.0, 0.0]]), 0.01 * np.eye(4))
    measured = np.array([[0.02, 0.01], [9.0, 9.0], [3.0, np.nan]])
    noise = np.broadcast_to(1e-4 * np.eye(2), (3, 2, 2))
    assert jcbb(measured[:2], noise[:2], prediction).tolist() == [0, -1]
    assert jcbb(np.zeros((0, 2)), noise[:0], prediction).tolist() == []


def test_angles_are_compared_across_the_seam() -> None:
    prediction = JointPrediction(np.array([[2.0, np.pi - 0.01]]), 1e-3 * np.eye(2))
    found = jcbb(np.array([[2.0, -np.pi + 0.01]]), 1e-3 * np.eye(2)[None], prediction, angles=(1,))
    assert found.tolist() == [0]


def test_smoothing_is_better_than_filtering(rng: np.random.Generator) -> None:
    config = PlanarConfig()
    filtered, smoothed = [], []
    for _ in range(15):
        truth, motions, _, seen, measured = drive(rng, config)
        _, poses, _, _, _ = run_filter(config, motions, seen, measured)
        ids, landmark_index = np.unique(np.concatenate(seen), return_inverse=True)
        pose_index = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
        graph = PlanarGraph(np.array(motions), MOTION_COVARIANCE, pose_index, landmark_index, np.concatenate(measured))
        result, report = smooth(graph, np.zeros(3), config)
        assert report.converged
        assert len(result.landmarks) == len(ids)
        filtered.append(np.mean([np.sum((t - p)[:2] ** 2) for t, p in zip(truth, poses, strict=True)]))
        smoothed.append(np.mean(np.sum((np.array(truth) - result.poses)[:, :2] ** 2, axis=1)))
    assert np.mean(smoothed) < np.mean(filtered)


def test_cost_of_the_solution_follows_chi_square(rng: np.random.Generator) -> None:
    config = PlanarConfig()
    _, motions, _, seen, measured = drive(rng, config)
    _, landmark_index = np.unique(np.concatenate(seen), return_inverse=True)
    pose_index = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
    graph = PlanarGraph(np.array(motions), MOTION_COVARIANCE, pose_index, landmark_index, np.concatenate(measured))
    result, report = smooth(graph, np.zeros(3), config)
    freedom = 2 * len(pose_index) - 2 * len(result.landmarks)
    low, high = anees_bounds(1, freedom, 0.999)
    assert low < report.cost / freedom < high


def test_measurement_between_known_and_new_is_discarded() -> None:
    ekf = PlanarEkf(PlanarConfig(method="mahalanobis"), np.zeros(3), np.zeros((3, 3)))
    ekf.process(np.array([[2.0, 0.0]]))
    _, slots = ekf.process(np.array([[2.24, 0.0]]))
    assert slots.tolist() == [-1]
    assert len(ekf.landmarks) == 1
    assert wrap(3 * np.pi) == pytest.approx(-np.pi)


def test_smoothed_poses_are_known_as_well_as_the_cost_is_curved(rng: np.random.Generator) -> None:
    """Without noise the cost's Hessian is twice the information."""
    config = PlanarConfig()
    poses = np.array([[0.0, 0.0, 0.1], [0.5, 0.1, 0.4], [0.8, 0.5, 0.9], [0.7, 1.0, 1.5]])
    landmarks = rng.uniform(-3.0, 3.0, (4, 2))
    seen = [range_bearing(pose, landmarks)[0] for pose in poses]
    motions = [np.append(turn(a[2]).T @ (b - a)[:2], b[2] - a[2]) for a, b in pairwise(poses)]
    k, n = np.indices((4, 4)).reshape(2, -1)
    graph = PlanarGraph(np.array(motions), MOTION_COVARIANCE, k, n, np.concatenate(seen))
    state, size = PlanarMap(poses, landmarks), 9 + 8

    def at(step: np.ndarray) -> float:
        moved = poses + np.vstack([np.zeros(3), step[:9].reshape(3, 3)])
        return cost(graph, PlanarMap(moved, landmarks + step[9:].reshape(4, 2)), config)

    steps = 1e-4 * np.eye(size)
    curvature = [[(at(a + b) - at(a - b) - at(b - a) + at(-a - b)) / 4e-8 for b in steps] for a in steps]
    expected = np.linalg.inv(0.5 * np.array(curvature))
    found = pose_covariances(graph, state, config, np.arange(4))
    np.testing.assert_array_equal(found[0], 0.0)
    for pose in (1, 2, 3):
        own = slice(3 * pose - 3, 3 * pose)
        np.testing.assert_allclose(found[pose], expected[own, own], rtol=1e-3, atol=1e-8)
