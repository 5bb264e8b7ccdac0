# SPDX-License-Identifier: Apache-2.0
"""The filter against independent implementations: dense algebra, filterpy, and the statistics of its own errors."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from ekf_slam_node.filtering import models
from ekf_slam_node.filtering.covariance import Covariance, whiten
from ekf_slam_node.filtering.ekf import Ekf
from feature_world import CAMERA, T_RIG_OPTICAL, PointWorld, room, wander
from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    invert_transform,
    make_transform,
    skew,
    so3_exp,
    so3_left_jacobian,
    transform_points,
)


def random_covariance(size: int, rng: np.random.Generator) -> FloatArray:
    A = rng.standard_normal((size, size))
    return A @ A.T + size * np.eye(size)


class TestCovariance:
    def test_columns_blocks_and_head_are_those_of_the_dense_matrix(self, rng: np.random.Generator) -> None:
        P = random_covariance(30, rng)
        owned = Covariance(P)
        np.testing.assert_array_equal(owned.dense(), P)
        np.testing.assert_array_equal(owned.columns(np.array([3, 17, 29]))[:30], P[:, [3, 17, 29]])
        np.testing.assert_array_equal(owned.head(12), P[:, :12])
        np.testing.assert_array_equal(owned.blocks(np.array([12, 21]))[1], P[21:24, 21:24])

    def test_grows_beyond_its_buffer_and_shrinks(self, rng: np.random.Generator) -> None:
        P = random_covariance(300, rng)
        owned = Covariance(P[:12, :12])
        for n in range(12, 300, 3):
            owned.append(P[n : n + 3, :n], P[n : n + 3, n : n + 3])
        np.testing.assert_array_equal(owned.dense(), P)
        order = list(range(300))
        for first in (12, 150, 120, 288):
            owned.remove(first, 3)
            order[first : first + 3] = order[-3:]
            order = order[:-3]
            np.testing.assert_array_equal(owned.dense(), P[np.ix_(order, order)])

    def test_square_and_product(self, rng: np.random.Generator) -> None:
        P = random_covariance(20, rng)
        owned = Covariance(P)
        A, B = rng.standard_normal((2, 20, 4))
        owned.subtract_square(np.asfortranarray(A))
        owned.add_product(np.asfortranarray(A), np.asfortranarray(B))
        expected = P - A @ A.T + A @ B.T + B @ A.T
        np.testing.assert_allclose(owned.dense(), expected, atol=1e-10)

    def test_an_impossible_innovation_covariance_is_refused(self) -> None:
        assert whiten(-np.eye(2), np.zeros((4, 2), order="F"), np.ones(2)) is None

    def test_a_cross_covariance_row_by_row_is_refused(self) -> None:
        with pytest.raises(ValueError, match="Fortran order"):
            whiten(np.eye(2), np.zeros((4, 2)), np.ones(2))


def test_agrees_with_filterpy(rng: np.random.Generator) -> None:
    """Time update, augmentation and measurement update in the plain error state."""
    velocity = 0.2 * rng.standard_normal(6)
    P = np.zeros((12, 12))
    P[6:, 6:] = 0.01 * np.eye(6)
    ekf = Ekf(velocity, P, invariant=False)
    camera_points = np.column_stack([rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 4), rng.uniform(2, 5, 4)])
    rig = transform_points(T_RIG_OPTICAL, camera_points)
    own = np.array([random_covariance(3, rng) * 1e-4 for _ in rig])
    slots = ekf.augment(rig, own)
    sigma, dt = np.full(6, 0.5), 0.1

    oracle = ExtendedKalmanFilter(dim_x=24, dim_z=12)
    oracle.x = np.zeros(24)
    oracle.P = np.zeros((24, 24))
    oracle.P[:12, :12] = P
    for i, block in enumerate(own):
        oracle.P[12 + 3 * i : 15 + 3 * i, 12 + 3 * i : 15 + 3 * i] = block
    oracle.F = np.eye(24)
    oracle.F[:12, :12] = models.motion_jacobian(np.eye(4), velocity, dt)
    G = np.zeros((24, 6))
    G[:12] = models.noise_gain(np.eye(3), velocity, dt)
    oracle.Q = (G * sigma**2) @ G.T

    ekf.apply_time_update(ekf.time_update(dt, sigma))
    oracle.predict()
    np.testing.assert_allclose(ekf.covariance.dense(), oracle.P, atol=1e-12)

    seen = models.observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks, CAMERA)
    variance = np.tile([0.3, 0.3, 1e-5], (4, 1))
    z = seen.z + 0.5 * np.sqrt(variance) * rng.standard_normal((4, 3))
    H = np.zeros((12, 24))
    H[:, :6] = seen.J_pose.reshape(12, 6)
    for i in range(4):
        H[3 * i : 3 * i + 3, 12 + 3 * i : 15 + 3 * i] = seen.J_point[i]
    before, landmarks = ekf.T, ekf.landmarks.copy()
    oracle.update((z - seen.z).ravel(), lambda _: H, lambda _: np.zeros(12), np.diag(variance.ravel()))
    report = ekf.update(z, variance, seen, slots)
    np.testing.assert_allclose(ekf.covariance.dense(), oracle.P, atol=1e-10)
    np.testing.assert_allclose(boxminus(ekf.T, before), oracle.x[:6], atol=1e-10)
    np.testing.assert_allclose(ekf.velocity - velocity, oracle.x[6:12], atol=1e-10)
    np.testing.assert_allclose(ekf.landmarks - landmarks, oracle.x[12:].reshape(4, 3), atol=1e-10)
    S = H @ oracle.P_prior @ H.T + np.diag(variance.ravel())
    assert report.nis == pytest.approx((z - seen.z).ravel() @ np.linalg.solve(S, (z - seen.z).ravel()), rel=1e-8)


def test_sightings_are_worth_what_the_joint_covariance_says(rng: np.random.Generator) -> None:
    """Innovation at the predicted mean, NIS and information, a prediction linearised at another motion included."""
    ekf, _, _, _ = seen_room(rng, 6)
    ekf.apply_time_update(ekf.time_update(0.1, np.full(6, 0.5), models.relative_motion(np.full(6, 0.3), 0.1)))
    ekf._offset[12:] = rng.normal(0.0, 0.01, len(ekf._offset) - 12)
    slots, common = np.array([4, 0, 2]), rng.uniform(0.01, 0.1, 6)
    seen = models.observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks[slots], CAMERA)
    variance = rng.uniform([0.1, 0.1, 1e-5], [0.3, 0.3, 1e-4], (3, 3))
    z = seen.z + rng.normal(size=(3, 3)) * np.sqrt(variance)
    found = ekf.sighted(z, variance, slots, T_RIG_OPTICAL, CAMERA, common)
    P, offset = ekf.covariance.dense(), ekf._offset
    assert np.abs(offset[:12]).max() > 0.01
    for name in ("z", "depth", "J_pose", "J_point"):
        np.testing.assert_allclose(getattr(found.seen, name), getattr(seen, name), rtol=1e-12)
    for i, slot in enumerate(slots):
        H = np.zeros((3, len(P)))
        H[:, :6], H[:, 12 + 3 * slot : 15 + 3 * slot] = seen.J_pose[i], seen.J_point[i]
        S = H @ P @ H.T + np.diag(variance[i]) + seen.J_pose[i] @ np.diag(common**2) @ seen.J_pose[i].T
        innovation = z[i] - seen.z[i] - H @ offset
        np.testing.assert_allclose(found.innovation[i], innovation, rtol=1e-9)
        assert found.nis[i] == pytest.approx(innovation @ np.linalg.solve(S, innovation), rel=1e-7)
        told = np.linalg.slogdet(S)[1] - np.sum(np.log(variance[i]))
        assert found.information[i] == pytest.approx(told, rel=1e-7)


@pytest.mark.parametrize("invariant", [True, False])
@pytest.mark.parametrize("landmarks", [0, 5, 70])
@pytest.mark.parametrize("turn", [0.0, 0.2])
def test_an_update_is_applied_as_numpy_has_it(
    invariant: bool, landmarks: int, turn: float, rng: np.random.Generator
) -> None:
    """Mean, covariance and, in the right-invariant error, its coordinates at the new estimate; strips of any size."""
    n = 12 + 3 * landmarks
    P, W, y = random_covariance(n, rng), 0.1 * rng.normal(size=(n, 9)), 0.3 * rng.normal(size=9)
    W[3:6] *= turn
    ekf = Ekf(rng.normal(size=6), P, invariant, landmarks=rng.normal(size=(landmarks, 3)))
    ekf.T = make_transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    before, R, velocity = np.vstack([ekf.T[:3, 3], ekf.landmarks]), ekf.T[:3, :3].copy(), ekf.velocity.copy()
    ekf._apply(np.asfortranarray(W), y)
    delta, expected = W @ y, P - W @ W.T
    shift = np.vstack([delta[:3], delta[12:].reshape(-1, 3)])
    moved = shift
    if invariant:
        V = so3_left_jacobian(delta[3:6])
        moved = before @ (so3_exp(delta[3:6]) - np.eye(3)).T + (shift - np.cross(delta[3:6], before)) @ V.T
        A = np.zeros((n, 3))
        A[:3], A[12:] = -skew(moved[0]), -skew(moved[1:]).reshape(-1, 3)
        B = expected[:, 3:6].copy()
        expected = expected + A @ B.T + B @ A.T + A @ B[3:6] @ A.T
    np.testing.assert_allclose(ekf.covariance.dense(), expected, atol=1e-10 * np.abs(P).max())
    np.testing.assert_allclose(np.vstack([ekf.T[:3, 3], ekf.landmarks]), before + moved, atol=1e-12)
    np.testing.assert_allclose(ekf.T[:3, :3], so3_exp(delta[3:6]) @ R, atol=1e-12)
    np.testing.assert_allclose(ekf.velocity, velocity + delta[6:12], atol=1e-12)


def seen_room(
    rng: np.random.Generator, steps: int
) -> tuple[Ekf, list[FloatArray], FloatArray, list[tuple[float, int]]]:
    """A filter with known association in a room, after some steps; the true poses, the true landmarks in its frame, and
    NIS with its degrees of freedom, step by step.
    """
    world, sigma = room(rng, 150), np.repeat([0.5, 0.4], 3)
    poses = wander(steps, 0.1, sigma, np.repeat([0.3, 0.2], 3), rng, 0.8)
    P = np.zeros((12, 12))
    P[6:, 6:] = np.diag(np.repeat([0.3, 0.2], 3) ** 2)
    ekf, slots = Ekf(np.zeros(6), P), np.full(150, -1)
    nis: list[tuple[float, int]] = []
    for k, T in enumerate(poses):
        if k:
            ekf.apply_time_update(ekf.time_update(0.1, sigma))
        nis += observe_all(ekf, world, T, slots, rng)
    truth = transform_points(invert_transform(poses[0]), world.points[np.argsort(slots)[-len(ekf.landmarks) :]])
    return ekf, poses, truth, nis


def observe_all(
    ekf: Ekf, world: PointWorld, T: FloatArray, slots: np.ndarray, rng: np.random.Generator
) -> list[tuple[float, int]]:
    features, index = world.features(T, 0, rng, detection=0.7)
    frame = models.frame_from_features(features, np.arange(len(features)), 0.01, 1e-5)
    known, new = np.flatnonzero(slots[index] >= 0), np.flatnonzero(slots[index] < 0)
    reports = []
    if len(known):
        which = slots[index[known]]
        seen = models.observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks[which], CAMERA)
        report = ekf.update(frame.z[known], frame.variance[known], seen, which)
        reports.append((report.nis, report.dof))
    points, covariances = models.rig_points(frame.select(new), T_RIG_OPTICAL)
    slots[index[new]] = ekf.augment(points, covariances)
    return reports


def test_errors_and_innovations_are_as_large_as_claimed() -> None:
    """ANEES of pose and map and the mean NIS over 20 runs inside their 95 % bounds."""
    pose, joint, innovations = [], [], []
    for seed in range(20):
        ekf, poses, truth, nis = seen_room(np.random.default_rng(seed), 12)
        innovations += nis
        error = boxminus(invert_transform(poses[0]) @ poses[-1], ekf.T)
        P = ekf.covariance.dense()
        pose.append(float(nees(error, P[:6, :6])) / 6)
        keep = np.r_[0:6, 12 : len(P)]
        both = np.concatenate([error, (truth - ekf.landmarks).ravel()])
        joint.append((float(nees(both, P[np.ix_(keep, keep)])), len(both)))
    low, high = anees_bounds(6, 20)
    assert low < np.mean(pose) < high
    total = int(sum(d for _, d in joint))
    low, high = anees_bounds(1, total)
    assert low < sum(e for e, _ in joint) / total < high
    nis_sum, dof = np.sum(innovations, axis=0)
    low, high = anees_bounds(1, int(dof))
    assert low < nis_sum / dof < high


@pytest.mark.parametrize(("invariant", "honest"), [(True, True), (False, False)])
def test_heading_gets_no_better_without_information(invariant: bool, honest: bool) -> None:
    """Section 6.2.4: a rig unsure of its heading learns nothing of it by looking at new things again and again."""
    rng = np.random.default_rng(1)
    world = room(rng, 200)
    P = np.zeros((12, 12))
    P[3:6, 3:6] = np.radians(10.0) ** 2 * np.eye(3)
    P[6:, 6:] = 1e-4 * np.eye(6)
    ekf, slots = Ekf(np.zeros(6), P, invariant), np.full(200, -1)
    start = boxplus(np.eye(4), np.concatenate([np.zeros(3), np.radians(10.0) * np.array([0.5, -0.8, 1.2])]))
    for k in range(30):
        if k:
            ekf.apply_time_update(ekf.time_update(0.1, np.full(6, 0.1)))
        observe_all(ekf, world, start, slots, rng)
    sigma = np.degrees(np.sqrt(np.diag(ekf.pose_covariance())[3:]))
    assert (sigma.min() > 9.99) == honest


def test_a_guess_far_from_the_prediction_gives_the_same_answer(rng: np.random.Generator) -> None:
    """Linearised at the motion found, a wide prior far away does not spoil the update."""
    world = room(rng, 150)
    P = np.zeros((12, 12))
    P[6:, 6:] = np.eye(6)
    ekf, slots = Ekf(np.zeros(6), P), np.full(150, -1)
    observe_all(ekf, world, np.eye(4), slots, rng)
    T = models.relative_motion(np.array([0.3, -0.1, 0.05, 0.1, -0.1, 0.35]), 1.0)
    ekf.apply_time_update(ekf.time_update(1.0, np.full(6, 2.0), T))
    observe_all(ekf, world, T, slots, rng)
    error = boxminus(T, ekf.T)
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.linalg.norm(error[3:]) < 0.01


def test_an_update_without_measurements_moves_to_the_prediction(rng: np.random.Generator) -> None:
    ekf = Ekf(np.array([1.0, 0, 0, 0, 0, 0]), np.diag([0.0] * 6 + [0.04] * 6), invariant=False)
    slots = ekf.augment(np.array([[3.0, 0.0, 0.0]]), np.eye(3)[None] * 1e-4)
    elsewhere = models.relative_motion(np.array([0.5, 0, 0, 0, 0, 0]), 0.1)
    ekf.apply_time_update(ekf.time_update(0.1, np.full(6, 0.1), elsewhere))
    before = ekf.covariance.dense()
    seen = models.observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks[slots], CAMERA).select(np.zeros(0, dtype=np.int64))
    report = ekf.update(np.zeros((0, 3)), np.zeros((0, 3)), seen, slots[:0])
    assert not report.applied
    np.testing.assert_allclose(ekf.T[:3, 3], [0.1, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(ekf.covariance.dense(), before)


def test_a_singular_innovation_changes_nothing_but_the_place_of_linearisation() -> None:
    ekf = Ekf(np.zeros(6), np.zeros((12, 12)))
    slots = ekf.augment(np.array([[3.0, 0.0, 0.0]]), np.zeros((1, 3, 3)))
    seen = models.observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks[slots], CAMERA)
    report = ekf.update(seen.z + 1.0, np.zeros((1, 3)), seen, slots)
    assert not report.applied
    np.testing.assert_array_equal(ekf.T, np.eye(4))
    assert ekf.is_finite
