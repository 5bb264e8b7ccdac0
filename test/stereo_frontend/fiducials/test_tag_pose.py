# SPDX-License-Identifier: Apache-2.0
"""Pose of a tag: as uncertain as it is wrong, by one image, by two, and with depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.geometry import FloatArray, boxminus, boxplus, make_transform, so3_exp, transform_points
from slam_core.tags import square
from stereo_frontend.fiducials.tag_pose import TagView, _residuals, estimate_tag_pose

CAMERA = Camera(752, 480, 450.0, 450.0, 376.0, 240.0)
SIGMA, BASELINE, SIZE = 0.3, 0.11, 0.16
FACING = so3_exp(np.array([np.pi, 0.0, 0.0]))


def view(T: FloatArray, rng: np.random.Generator, kind: str) -> TagView:
    corners = transform_points(T, square(SIZE))
    left = CAMERA.project(corners) + SIGMA * rng.normal(size=(4, 2))
    seen = TagView(CAMERA, left, SIGMA)
    if kind == "pair":
        right = CAMERA.project(corners - [BASELINE, 0.0, 0.0]) + SIGMA * rng.normal(size=(4, 2))
        return replace(seen, right=right, right_sigma=np.full(4, SIGMA), baseline=BASELINE)
    if kind == "depth":
        inside = transform_points(T, 0.5 * square(SIZE))
        z = inside[:, 2] + 0.01 * rng.normal(size=4)
        return replace(seen, rays=inside[:, :2] / inside[:, 2:], depth=z, depth_sigma=np.full(4, 0.01))
    return seen


def some_pose(rng: np.random.Generator, far: float = 2.5, tilt: float = 0.4) -> FloatArray:
    """T_optical_tag of a tag that shows its face: a detector finds none that is nearly edge-on."""
    while True:
        t = np.array([*rng.normal(0, 0.25, 2), rng.uniform(0.6, far)])
        T = make_transform(FACING @ so3_exp(rng.normal(0, tilt, 3)), t)
        if -T[:3, 2] @ t > 0.5 * np.linalg.norm(t):
            return T


@pytest.mark.parametrize("kind", ["pair", "depth"])
def test_errors_are_as_large_as_claimed(kind: str, rng: np.random.Generator) -> None:
    squares, depth = [], []
    for _ in range(300):
        T = some_pose(rng)
        found = estimate_tag_pose(view(T, rng, kind), SIZE)
        assert found is not None
        assert found.fits
        error = boxminus(T, found.T)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        depth.append(np.mean(((found.depth - transform_points(T, square(SIZE))[:, 2]) / found.sigma) ** 2))
    assert 5.0 < np.mean(squares) < 7.5
    assert 0.8 < np.mean(depth) < 1.3


def test_where_a_second_pose_fits_nearly_as_well_the_covariance_covers_both(rng: np.random.Generator) -> None:
    inside, ambiguous = 0, 0
    for _ in range(200):
        T = some_pose(rng, far=3.5, tilt=0.3)
        found = estimate_tag_pose(view(T, rng, "one"), SIZE)
        assert found is not None
        if not found.is_ambiguous:
            continue
        ambiguous += 1
        error = boxminus(T, found.T)
        inside += error @ np.linalg.solve(found.covariance, error) < 16.8  # 99 % of 6 degrees of freedom
    assert ambiguous > 50
    assert inside > 0.96 * ambiguous


def test_depth_tells_two_poses_apart(rng: np.random.Generator) -> None:
    T = make_transform(FACING @ so3_exp(np.array([0.0, 0.5, 0.0])), np.array([0.1, 0.0, 2.5]))
    counts = [sum(estimate_tag_pose(view(T, rng, k), SIZE).is_ambiguous for _ in range(30)) for k in ("one", "pair")]
    assert counts[1] < counts[0]


def test_the_jacobian_is_the_derivative(rng: np.random.Generator) -> None:
    for kind in ("pair", "depth"):
        seen, T = view(some_pose(rng), rng, kind), some_pose(rng)
        _, J = _residuals(seen, square(SIZE), T)
        h = 1e-6
        for k in range(6):
            d = h * np.eye(6)[k]
            ahead, behind = (_residuals(seen, square(SIZE), boxplus(T, s * d))[0] for s in (1.0, -1.0))
            np.testing.assert_allclose(J[:, k], (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-3)


def test_a_tag_of_another_size_does_not_fit_a_pair(rng: np.random.Generator) -> None:
    found = estimate_tag_pose(view(make_transform(FACING, np.array([0.0, 0.0, 0.8])), rng, "pair"), 0.8 * SIZE)
    assert found is not None
    assert not found.fits


@pytest.mark.parametrize(
    "corners", [np.zeros((4, 2)), np.full((4, 2), np.nan), np.array([[0, 0], [1, 0], [2, 0], [3, 0]])]
)
def test_what_is_no_square_gives_no_pose_or_one_that_does_not_fit(corners: FloatArray) -> None:
    found = estimate_tag_pose(TagView(CAMERA, corners.astype(float), SIGMA), SIZE)
    assert found is None or not found.fits
