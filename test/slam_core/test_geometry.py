# SPDX-License-Identifier: Apache-2.0
"""Geometry against scipy's Rotation (a second implementation), its own algebra, and central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from slam_core import geometry as g

FloatArray = g.FloatArray

settings.register_profile("slam", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("slam")

coordinates = st.floats(-10.0, 10.0, allow_nan=False)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
unit_vectors = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
# Angles at both delicate ends: at and near zero, at and near pi.
angles = st.one_of(
    st.floats(0.0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4, np.pi - 1e-4, np.pi - 1e-7, np.pi - 1e-9, np.pi]),
)
rotation_vectors = st.tuples(unit_vectors, angles).map(lambda pair: pair[0] * pair[1])
moderate_vectors = st.tuples(unit_vectors, st.floats(0.0, 2.8)).map(lambda pair: pair[0] * pair[1])
transforms = st.tuples(rotation_vectors, vectors).map(lambda pair: g.make_transform(g.so3_exp(pair[0]), pair[1]))


def central_difference(function: Callable[[FloatArray], FloatArray], size: int = 6, step: float = 1e-6) -> FloatArray:
    columns = [(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)]
    return np.column_stack(columns)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(g.skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(rotation_vectors)
def test_exp_agrees_with_scipy(phi: FloatArray) -> None:
    np.testing.assert_allclose(g.so3_exp(phi), Rotation.from_rotvec(phi).as_matrix(), atol=1e-13)


@given(rotation_vectors)
def test_log_agrees_with_scipy_up_to_pi(phi: FloatArray) -> None:
    R = Rotation.from_rotvec(phi).as_matrix()
    log = g.so3_log(R)
    assert np.linalg.norm(log) <= np.pi + 1e-12
    np.testing.assert_allclose(g.so3_exp(log), R, atol=1e-12)
    if np.linalg.norm(phi) < np.pi - 1e-6:
        np.testing.assert_allclose(log, phi, atol=1e-9)


@given(moderate_vectors)
def test_left_jacobian_is_the_derivative_of_exp(phi: FloatArray) -> None:
    numeric = central_difference(lambda d: g.so3_log(g.so3_exp(phi + d) @ g.so3_exp(phi).T), size=3)
    np.testing.assert_allclose(g.so3_left_jacobian(phi), numeric, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.99e-4, 1.01e-4, 1e-3, 1.0, 3.1, 5.0])
def test_left_jacobian_inverse_is_the_inverse(angle: float) -> None:
    phi = angle * np.array([0.6, -0.8, 0.0])
    np.testing.assert_allclose(g.so3_left_jacobian(phi) @ g.so3_left_jacobian_inverse(phi), np.eye(3), atol=1e-9)


@given(rotation_vectors)
def test_quaternion_agrees_with_scipy(phi: FloatArray) -> None:
    rotation = Rotation.from_rotvec(phi)
    ours, theirs = g.quaternion_from_rotation(rotation.as_matrix()), rotation.as_quat()
    assert ours[3] >= 0.0
    assert min(np.abs(ours - theirs).max(), np.abs(ours + theirs).max()) < 1e-12
    np.testing.assert_allclose(g.rotation_from_quaternion(ours), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("quaternion", [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.1], [np.nan, 0.0, 0.0, 1.0]])
def test_a_quaternion_without_unit_norm_is_refused(quaternion: list[float]) -> None:
    for one_or_many in (np.array(quaternion), np.array([quaternion, [0.0, 0.0, 0.0, 1.0]])):
        with pytest.raises(ValueError, match="unit norm"):
            g.rotation_from_quaternion(one_or_many)


def test_the_rotation_of_one_quaternion_is_that_of_many_to_the_bit(rng: np.random.Generator) -> None:
    quaternions = rng.normal(size=(200, 4))
    quaternions *= rng.uniform(0.995, 1.005, (200, 1)) / np.linalg.norm(quaternions, axis=1, keepdims=True)
    each = np.array([g.rotation_from_quaternion(q) for q in quaternions])
    np.testing.assert_array_equal(each, g.rotation_from_quaternion(quaternions))


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_euler_angles_agree_with_scipy(yaw: float, pitch: float, roll: float) -> None:
    R = g.rotation_from_euler(yaw, pitch, roll)
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(g.euler_from_rotation(R), [yaw, pitch, roll], atol=1e-10)


@given(transforms, transforms)
def test_boxminus_undoes_boxplus(T: FloatArray, reference: FloatArray) -> None:
    np.testing.assert_allclose(g.boxplus(reference, g.boxminus(T, reference)), T, atol=1e-11)


@given(transforms, moderate_vectors, vectors)
def test_boxplus_acts_along_the_parent_axes(T: FloatArray, phi: FloatArray, t: FloatArray) -> None:
    moved = g.boxplus(T, np.concatenate([t, phi]))
    np.testing.assert_allclose(moved[:3, 3], T[:3, 3] + t, atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3], Rotation.from_rotvec(phi).as_matrix() @ T[:3, :3], atol=1e-12)


@given(transforms, vectors)
def test_inverse_undoes_the_transform(T: FloatArray, point: FloatArray) -> None:
    moved = g.transform_points(T, point[None])
    np.testing.assert_allclose(g.transform_points(g.invert_transform(T), moved)[0], point, atol=1e-11)


@given(transforms, transforms)
def test_compose_jacobians_against_central_differences(A: FloatArray, B: FloatArray) -> None:
    J_a, J_b = g.compose_jacobians(A, B)
    np.testing.assert_allclose(J_a, central_difference(lambda d: g.boxminus(g.boxplus(A, d) @ B, A @ B)), atol=1e-6)
    np.testing.assert_allclose(J_b, central_difference(lambda d: g.boxminus(A @ g.boxplus(B, d), A @ B)), atol=1e-6)


@given(transforms)
def test_inverse_jacobian_against_central_differences(T: FloatArray) -> None:
    inverse = g.invert_transform(T)
    numeric = central_difference(lambda d: g.boxminus(g.invert_transform(g.boxplus(T, d)), inverse))
    np.testing.assert_allclose(g.inverse_jacobian(T), numeric, atol=1e-6)


def test_compose_covariance_is_the_spread_of_composed_samples(rng: np.random.Generator) -> None:
    A = g.make_transform(g.so3_exp(np.array([0.3, -0.5, 1.2])), np.array([1.0, 2.0, -0.5]))
    B = g.make_transform(g.so3_exp(np.array([-0.9, 0.1, 0.4])), np.array([0.4, -3.0, 0.7]))
    L_a, L_b = (0.003 * rng.normal(size=(6, 6)) for _ in range(2))
    predicted = g.compose_covariance(A, L_a @ L_a.T, B, L_b @ L_b.T)
    d_a, d_b = (rng.normal(size=(20000, 6)) @ L.T for L in (L_a, L_b))
    errors = g.boxminus(g.boxplus(A, d_a) @ g.boxplus(B, d_b), A @ B)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((np.cov(errors.T) - predicted) / scale).max() < 0.05


@given(transforms, transforms, st.floats(0.0, 1.0))
def test_interpolation_ends_at_its_ends_and_moves_evenly(A: FloatArray, B: FloatArray, fraction: float) -> None:
    np.testing.assert_allclose(g.interpolate_transform(A, B, np.array(0.0)), A, atol=1e-12)
    np.testing.assert_allclose(g.interpolate_transform(A, B, np.array(1.0)), B, atol=1e-11)
    part = g.boxminus(g.interpolate_transform(A, B, np.array(fraction)), A)
    np.testing.assert_allclose(part, fraction * g.boxminus(B, A), atol=1e-8)


@given(transforms)
def test_pose7_round_trip(T: FloatArray) -> None:
    np.testing.assert_allclose(g.transform_from_pose7(g.pose7_from_transform(T)), T, atol=1e-12)


def test_batches_are_the_single_results_stacked(rng: np.random.Generator) -> None:
    phi = rng.normal(size=(2, 5, 3))
    phi[0, 0] = 0.0
    R = g.so3_exp(phi)
    functions: list[tuple[Callable[..., FloatArray], FloatArray]] = [
        (g.so3_exp, phi), (g.so3_left_jacobian, phi), (g.so3_left_jacobian_inverse, phi), (g.skew, phi),
        (g.so3_log, R), (g.quaternion_from_rotation, R), (g.euler_from_rotation, R),
    ]  # fmt: skip
    for function, batch in functions:
        result = function(batch)
        for index in np.ndindex(2, 5):
            np.testing.assert_allclose(result[index], function(batch[index]), atol=1e-14, err_msg=function.__name__)


def test_optical_axes_are_those_of_rep_103() -> None:
    forward, left, up = np.eye(3)
    np.testing.assert_array_equal(g.OPTICAL_FROM_RIG @ forward, [0, 0, 1])
    np.testing.assert_array_equal(g.OPTICAL_FROM_RIG @ left, [-1, 0, 0])
    np.testing.assert_array_equal(g.OPTICAL_FROM_RIG @ up, [0, -1, 0])
    assert np.linalg.det(g.OPTICAL_FROM_RIG) == 1.0


def test_rigid_transforms_are_told_from_others() -> None:
    T = g.make_transform(g.so3_exp(np.array([0.1, 0.2, 0.3])), np.ones(3))
    assert g.is_rigid_transform(T)
    mirrored, scaled, not_finite = T.copy(), T.copy(), T.copy()
    mirrored[:3, 0] *= -1.0
    scaled[:3, :3] *= 1.01
    not_finite[0, 3] = np.nan
    for bad in (mirrored, scaled, not_finite, np.eye(3)):
        assert not g.is_rigid_transform(bad)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-3, 1.0, np.pi - 1e-9, np.pi, 3.0, 6.0])
def test_one_rotation_is_that_of_a_batch_of_one(angle: float, rng: np.random.Generator) -> None:
    for axis in (*np.eye(3), *rng.normal(size=(10, 3))):
        phi = angle * axis / np.linalg.norm(axis)
        R = g.so3_exp(phi)
        np.testing.assert_allclose(R, g.so3_exp(phi[None])[0], rtol=0, atol=4e-15)
        np.testing.assert_allclose(
            g.quaternion_from_rotation(R), g.quaternion_from_rotation(R[None])[0], rtol=0, atol=4e-15
        )


def test_vectors_that_are_not_finite_give_no_rotation_and_no_error() -> None:
    assert np.isnan(g.so3_exp(np.array([np.inf, 0.0, 0.0]))).all()
    assert np.isnan(g.so3_exp(np.array([np.nan, 0.0, 0.0]))).any()
    assert np.isnan(g.quaternion_from_rotation(np.full((3, 3), np.nan))).all()
