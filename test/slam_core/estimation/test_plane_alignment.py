# SPDX-License-Identifier: Apache-2.0
"""Points of two planes: the transform, its covariance, which points are left out, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.estimation.plane_alignment import PlanePoints, align_plane
from slam_core.geometry import FloatArray

PLACES = np.array([[0.0, 0.0], [8.0, 1.0], [7.0, 6.0], [-1.0, 5.0], [3.0, 9.0]])
SHIFT, YAW, SCALE = np.array([4.0, -2.0]), 0.7, 0.02


def turned(places: FloatArray) -> FloatArray:
    c, s = np.cos(YAW), np.sin(YAW)
    return places @ np.array([[c, s], [-s, c]]) + SHIFT


def points(places: FloatArray, target: FloatArray, sigma: float = 0.03, *, is_scale_known: bool = True) -> PlanePoints:
    unit = 1.0 if is_scale_known else SCALE
    return PlanePoints(places, target / unit, np.array(sigma), np.array(sigma / unit), is_scale_known)


@pytest.mark.parametrize("is_scale_known", [True, False])
@pytest.mark.parametrize("n", [2, 3, 5])
def test_exact_points_give_the_transform_and_the_scale_of_the_plan(n, is_scale_known):
    found = align_plane(points(PLACES[:n], turned(PLACES[:n]), is_scale_known=is_scale_known))
    np.testing.assert_allclose(found.translation, SHIFT, atol=1e-9)
    assert found.yaw == pytest.approx(YAW)
    assert found.scale == pytest.approx(1.0 if is_scale_known else SCALE)
    assert (found.scale_sigma > 0.0) is not is_scale_known
    assert found.freedom == 2 * n - (3 if is_scale_known else 4)
    assert found.inliers.all()


@pytest.mark.parametrize("is_scale_known", [True, False])
@pytest.mark.parametrize("n", [2, 5])
def test_the_covariance_is_that_of_the_errors(rng, n, is_scale_known):
    errors, sigma = [], 0.02
    for _ in range(600):
        a, b = (side + rng.normal(0.0, sigma, side.shape) for side in (PLACES[:n], turned(PLACES[:n])))
        try:
            found = align_plane(points(a, b, sigma, is_scale_known=is_scale_known))
        except ValueError:  # one in a thousand
            continue
        if found.inliers.all():
            errors.append([*(found.translation - SHIFT), found.yaw - YAW])
    assert len(errors) > 570
    P = align_plane(points(PLACES[:n], turned(PLACES[:n]), sigma, is_scale_known=is_scale_known)).covariance
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(P), errors).mean() / 3.0
    assert 0.85 < nees < 1.15


def test_a_surer_point_weighs_more():
    target = turned(PLACES)
    target[0] += [0.3, 0.0]
    sigma = np.full(5, 0.3)
    even = align_plane(PlanePoints(PLACES, target, sigma, sigma))
    sigma[0] = 0.01
    sure = align_plane(PlanePoints(PLACES, target, sigma, sigma))
    assert np.linalg.norm(sure.residuals[0]) < 0.1 * np.linalg.norm(even.residuals[0])


@pytest.mark.parametrize("is_scale_known", [True, False])
def test_of_four_points_the_one_that_contradicts_the_others_is_left_out(is_scale_known):
    for wrong in range(4):
        target = turned(PLACES[:4])
        target[wrong] += [0.8, -0.5]
        found = align_plane(points(PLACES[:4], target, is_scale_known=is_scale_known))
        assert list(np.flatnonzero(~found.inliers)) == [wrong]
        np.testing.assert_allclose(found.translation, SHIFT, atol=1e-9)


def test_with_three_points_or_with_half_of_them_wrong_nothing_is_guessed():
    three = turned(PLACES[:3])
    three[2] += [0.8, -0.5]
    with pytest.raises(ValueError, match=r"disagree .*point \d is off by the most.*fourth"):
        align_plane(points(PLACES[:3], three))
    four = turned(PLACES[:4])
    four[2:] += [[0.8, -0.5], [-0.4, 0.9]]
    with pytest.raises(ValueError, match="disagree"):
        align_plane(points(PLACES[:4], four))


def test_two_points_must_be_as_far_apart_on_both_sides():
    with pytest.raises(ValueError, match=r"points 1 and 2 disagree .* 8\.06 m apart in the map and 16\.12 m"):
        align_plane(points(PLACES[:2], 2.0 * turned(PLACES[:2])))


@pytest.mark.parametrize("is_scale_known", [True, False])
@pytest.mark.parametrize("n", [3, 5])
def test_mirrored_points_are_refused_as_such(n, is_scale_known):
    target = turned(PLACES[:n]) * [1.0, -1.0]
    with pytest.raises(ValueError, match="mirrored"):
        align_plane(points(PLACES[:n], target, is_scale_known=is_scale_known))


def test_points_that_coincide_are_refused():
    with pytest.raises(ValueError, match="points 1 and 2 coincide in the map"):
        align_plane(points(PLACES[[0, 0]], turned(PLACES[:2])))
    with pytest.raises(ValueError, match="the points all coincide on the plan"):
        align_plane(points(PLACES[:3], turned(PLACES[[0, 0, 0]]) + 0.01 * PLACES[:3]))


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="2 to 60 pairs"):
        points(PLACES[:1], PLACES[:1])
    with pytest.raises(ValueError, match="finite"):
        points(PLACES[:2], np.array([[0.0, np.nan], [1.0, 1.0]]))
    with pytest.raises(ValueError, match="positive"):
        points(PLACES[:2], PLACES[:2], 0.0)
