# SPDX-License-Identifier: Apache-2.0
"""The report warns of a dishonest covariance and shows what needs no ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_bringup.pipeline.results import AgentResult, LandmarkMap, RunResult
from slam_bringup.report.agent_figures import motion_figure, side_view, sigma_figure
from slam_bringup.report.report import verdict
from slam_core.evaluation import evaluate
from slam_core.geometry import boxplus
from slam_core.trajectory import Trajectory

N, RATE, RADIUS = 100, 10.0, 2.0


@pytest.fixture
def circle() -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, N)
    d = np.zeros((N, 6))
    d[:, 0], d[:, 1], d[:, 5] = RADIUS * np.sin(angle), RADIUS * (1 - np.cos(angle)), angle
    poses = boxplus(np.tile(np.eye(4), (N, 1, 1)), d)
    stamps = (np.arange(N) * 1e9 / RATE).astype(np.int64)
    return Trajectory(stamps, poses, np.tile(np.diag(np.repeat([1e-4, 1e-6], 3)), (N, 1, 1)))


@pytest.mark.parametrize(("claimed", "words"), [(1.0, "about as large"), (0.25, "do not rely"), (4.0, "too cautious")])
def test_the_verdict_follows_the_ratio_of_errors_to_claims(circle, rng, claimed, words):
    sigma = np.repeat([1e-2, 1e-3], 3)
    noise = rng.standard_normal((N, 6)) * sigma
    noise[0] = 0.0
    noisy = Trajectory(circle.stamps_ns, boxplus(circle.poses, noise), claimed**2 * circle.covariances)
    assert words in verdict(evaluate(noisy, circle))


def test_there_is_no_verdict_without_truth():
    assert verdict(None) == ""


def test_speed_and_turn_rate_are_those_of_the_circle(circle):
    figure = motion_figure(AgentResult("", circle))
    speed, turn = (line.get_ydata() for line in figure.axes[1].lines)
    expected = 2 * np.pi / ((N - 1) / RATE)
    np.testing.assert_allclose(np.median(turn), expected, rtol=0.01)
    np.testing.assert_allclose(np.median(speed), RADIUS * expected, rtol=0.01)


def test_the_sigmas_are_the_maps_own(circle):
    figure = sigma_figure(AgentResult("", circle))
    assert [line.get_ydata()[5] for line in figure.axes[0].lines] == pytest.approx([10.0] * 3)  # mm
    assert sigma_figure(AgentResult("", replace(circle, covariances=None))) is None


def test_the_side_view_needs_a_path(circle):
    empty = RunResult.__new__(RunResult)
    object.__setattr__(empty, "agents", ())
    assert side_view(empty) is None
    object.__setattr__(empty, "agents", (AgentResult("", circle),))
    object.__setattr__(empty, "landmarks", LandmarkMap.empty())
    assert side_view(empty).axes[0].get_ylabel() == "z [m]"
