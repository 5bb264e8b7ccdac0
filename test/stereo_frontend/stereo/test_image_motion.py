# SPDX-License-Identifier: Apache-2.0
"""Velocities from the motions between frames, and what they do to pixels of the right image."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.geometry import make_transform, so3_exp, transform_points
from stereo_frontend.stereo.image_motion import REACH, PredictedVelocity, Step, central_velocity, right_flow

STEREO = StereoCamera(Camera(640, 480, 400.0, 410.0, 315.0, 245.0), 0.12)


def right_pixels(points: np.ndarray) -> np.ndarray:
    return STEREO.camera.project(points - [STEREO.baseline, 0.0, 0.0])


@pytest.mark.parametrize("axis", range(6))
def test_the_flow_is_the_derivative_of_the_projection(axis: int) -> None:
    rng = np.random.default_rng(axis)
    points = rng.uniform([-2.0, -1.0, 1.0], [2.0, 1.0, 8.0], (50, 3))
    velocity, dt = np.eye(6)[axis], 1e-6
    moved = transform_points(make_transform(so3_exp(dt * velocity[3:]), dt * velocity[:3]), points)
    expected = (right_pixels(moved) - right_pixels(points)) / dt
    disparity = STEREO.camera.fx * STEREO.baseline / points[:, 2]
    flow = right_flow(STEREO, right_pixels(points), disparity) @ velocity
    np.testing.assert_allclose(flow, expected, atol=2e-2)


def steps(times: np.ndarray) -> tuple[list[Step], np.ndarray]:
    """Steps of a walker between the times, with swaying at 1.7 Hz, and the velocity at each time."""
    w = 2.0 * np.pi * 1.7
    way = 0.7 * times + 0.02 * np.sin(w * times)
    velocity = 0.7 + 0.02 * w * np.cos(w * times)
    increments = np.outer(np.diff(way), np.eye(6)[0])
    return [Step(dt, d) for dt, d in zip(np.diff(times), increments, strict=True)], velocity


def test_the_velocity_of_a_walker_is_found_to_some_hundredths() -> None:
    """Also with uneven stamps; the mean over the two steps beside the frame is off by a fifth of the swaying."""
    rng = np.random.default_rng(3)
    for start in np.linspace(0.0, 0.6, 13):
        times = start + 0.1 * np.arange(2 * REACH + 1) + rng.uniform(-0.01, 0.01, 2 * REACH + 1)
        found, velocity = steps(times)
        assert central_velocity(found[:REACH], found[REACH:])[0] == pytest.approx(velocity[REACH], abs=0.012)


def test_the_covariance_of_predictions_follows_their_errors() -> None:
    rng = np.random.default_rng(4)
    predicted = PredictedVelocity()
    still = [Step(0.1, np.zeros(6))] * 4
    sigma = np.array([0.02, 0.03, 0.04, 0.01, 0.02, 0.03])
    for _ in range(300):
        predicted.learn(still, sigma * rng.standard_normal(6))
    predicted(still)
    ratio = np.sqrt(np.diagonal(predicted.covariance)) / sigma
    assert ratio.min() > 0.4
    assert ratio.max() < 2.0


def test_each_way_to_predict_has_its_own_covariance() -> None:
    """After a gap the mean of one step is all there is, and the line after a step of another length is no better."""
    found, velocity = steps(0.1 * np.arange(120))
    predicted = PredictedVelocity()
    for k in range(4, 119):
        predicted.learn(found[:k], velocity[k] * np.eye(6)[0])
    long = [*found[:100], Step(0.2, found[100].increment + found[101].increment)]
    sigmas = []
    for given in (found[:100], found[98:100], found[99:100], long):
        predicted(given)
        sigmas.append(np.sqrt(predicted.covariance[0, 0]))
    assert sigmas[0] < sigmas[1] < sigmas[2] < 0.6 * sigmas[3]
    errors = [abs(predicted(found[k - 1 : k])[0] - velocity[k]) for k in range(60, 119)]
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / sigmas[2] < 1.5


def test_a_steady_acceleration_is_predicted() -> None:
    times = np.array([0.0, 0.1, 0.25])
    way = 0.5 * times**2
    found = [Step(dt, d * np.eye(6)[0]) for dt, d in zip(np.diff(times), np.diff(way), strict=True)]
    assert PredictedVelocity()(found)[0] == pytest.approx(times[-1])
    turned = Step.between(make_transform(so3_exp(np.array([0.0, 0.2, 0.0])), np.zeros(3)), 0.1)
    np.testing.assert_allclose(turned.velocity, [0, 0, 0, 0, 2.0, 0], atol=1e-12)


def test_the_steps_of_a_walker_are_learnt() -> None:
    """After some seconds a swaying is predicted three times better than by a straight line."""
    found, velocity = steps(0.1 * np.arange(80))
    predicted, errors = PredictedVelocity(), []
    for k in range(4, 79):
        both = predicted(found[:k]), PredictedVelocity()(found[:k])
        errors.append([abs(guess[0] - velocity[k]) for guess in both])
        predicted.learn(found[:k], velocity[k] * np.eye(6)[0])
    learnt, linear = np.mean(errors[-20:], axis=0)
    assert learnt < 0.3 * linear
    # Steps of uneven length are not those that the weights are for.
    uneven = [*found[:6], Step(0.2, 0.14 * np.eye(6)[0])]
    assert predicted(uneven)[0] == PredictedVelocity()(uneven)[0]
