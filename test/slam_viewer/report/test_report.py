# SPDX-License-Identifier: Apache-2.0
"""The report warns of a dishonest covariance and shows what needs no ground truth."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.surface import Surface
from slam_bringup.terminal.console import show
from slam_core.evaluation import evaluate
from slam_core.geometry import boxplus, make_transform
from slam_core.trajectory import Trajectory
from slam_viewer.report.agent_figures import motion_figure, side_view, sigma_figure
from slam_viewer.report.figures import floor_plan_figure, map_figure, png
from slam_viewer.report.report import draw_charts, verdict, write_report
from slam_viewer.report.summary_table import summary_table
from slam_viewer.results import AgentResult, LandmarkMap, RunResult, summarise

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


def test_hostile_names_and_reasons_are_plain_text_in_the_report_and_on_the_terminal(circle, tmp_path, capsys):
    hostile = "<img src=x onerror='alert(1)'> [/b] $\\frac{1$"
    result = RunResult(
        bag=hostile, mode="stereo", mapper="sjsam", odometry="none",
        agents=(AgentResult(hostile, circle, sensors=(hostile,)),),
        landmarks=LandmarkMap.empty(), dense=Surface.empty(), floor_plans=(), submaps=0, loop_closures=0, frames=3,
        dropped={hostile: 1}, rejections={hostile: 1}, sensor_s=1.0, wall_s=1.0, stage_ms={}, events=(hostile,),
        solver=hostile, changed={hostile: hostile},
    )  # fmt: skip
    made = {"version": hostile, "command": hostile, "date": hostile, "total_s": 1.0}
    summary = summarise(result) | made
    write_report(tmp_path / "report.html", result, summary, png(map_figure(result), 50), draw_charts(result))
    html = (tmp_path / "report.html").read_text()
    assert "<img src=x" not in html
    assert html.count("&lt;img src=x onerror=&#39;alert(1)&#39;&gt; [/b] $") >= 9
    show(summary_table(summary, Path(hostile)))
    assert "[/b]" in capsys.readouterr().out


def test_the_truth_is_drawn_thinly_on_the_way_that_would_hide_it(circle):
    (axes,) = map_figure(_result(AgentResult("", circle, truth=circle))).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["ground truth"].get_zorder() > lines["trajectory"].get_zorder()
    assert lines["ground truth"].get_linewidth() < 0.5 * lines["trajectory"].get_linewidth()


def test_plan_and_map_have_one_origin(circle):
    plan = FloorPlan(np.zeros((40, 60), dtype=np.int8), 0.1, make_transform(np.eye(3), np.array([-2.0, -1.0, 0.3])))
    result = _result(AgentResult("", circle), (plan,))
    (axes,) = floor_plan_figure(result, plan).axes
    assert axes.get_images()[0].get_extent() == pytest.approx([-2.0, 4.0, -1.0, 3.0])
    (way,) = (line for line in axes.get_lines() if line.get_label() == "trajectory")
    assert np.allclose(way.get_xydata(), circle.poses[:, :2, 3])


def test_the_report_names_its_plans_and_dims_its_charts_in_the_dark(circle, tmp_path):
    plan = FloorPlan(np.zeros((4, 6), dtype=np.int8), 0.1, np.eye(4))
    result = _result(AgentResult("", circle), (plan, plan))
    summary = summarise(result) | {"version": "1", "command": "slam", "date": "today", "total_s": 1.0}
    write_report(tmp_path / "report.html", result, summary, png(map_figure(result), 50), draw_charts(result))
    html = (tmp_path / "report.html").read_text()
    assert re.findall(r"<code>(floor_plan.*?)</code>", html) == ["floor_plan_0.yaml", "floor_plan_1.yaml"]
    assert "<b>1</b><span>loop closure</span>" in html
    charts = re.findall(r'<img ([^>]*?)src="data:image/png', html)
    assert len(charts) >= 6
    assert set(charts) == {'class="plot" ', 'class="plan" '}


def _result(agent: AgentResult, plans: tuple[FloorPlan, ...] = ()) -> RunResult:
    return RunResult(
        bag="a", mode="stereo", mapper="sjsam", odometry="none", agents=(agent,), landmarks=LandmarkMap.empty(),
        dense=Surface.empty(), floor_plans=plans, submaps=1, loop_closures=1, frames=3, dropped={}, rejections={},
        sensor_s=1.0, wall_s=1.0, stage_ms={}, events=(), solver="", changed={},
    )  # fmt: skip
