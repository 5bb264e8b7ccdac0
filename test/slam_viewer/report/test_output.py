# SPDX-License-Identifier: Apache-2.0
"""The files of a run: complete, consistent with each other, and readable by other programs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.surface import Surface
from slam_core.geometry import boxplus
from slam_core.trajectory import Trajectory, read_trajectory
from slam_viewer.report.early_output import EarlyOutput
from slam_viewer.report.output import write_results
from slam_viewer.report.result_bag import write_result_bag
from slam_viewer.results import AgentResult, LandmarkMap, RunResult


def circle(n: int = 80, radius: float = 2.0) -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, n)
    d = np.zeros((n, 6))
    d[:, 0], d[:, 1], d[:, 5] = radius * np.sin(angle), radius * (1 - np.cos(angle)), angle
    poses = boxplus(np.tile(np.eye(4), (n, 1, 1)), d)
    covariances = np.stack([np.eye(6) * 1e-5 * (1 + i) for i in range(n)])
    return Trajectory(np.arange(n, dtype=np.int64) * 100_000_000, poses, covariances)


def plate() -> Surface:
    """A square metre of floor in two triangles."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    colours = np.full((4, 3), 128, dtype=np.uint8)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    return Surface(points, normals, colours, np.full(4, 0.01, dtype=np.float32), faces)


def corridor() -> FloorPlan:
    """A corridor of 4 m between two walls, its ends not yet seen."""
    cells = np.full((40, 80), -1, dtype=np.int8)
    cells[10:30, 5:75] = 0
    cells[[9, 30], 5:75] = 100
    return FloorPlan(cells, 0.05, np.eye(4))


@pytest.fixture
def result(rng) -> RunResult:
    truth = circle()
    noisy = Trajectory(truth.stamps_ns, boxplus(truth.poses, rng.normal(0, 0.01, (len(truth), 6))), truth.covariances)
    positions = rng.uniform([-4, -2, -1], [4, 6, 2], (200, 3))
    covariances = np.stack([np.diag(s) for s in rng.uniform(1e-4, 1e-2, (200, 3))])
    return RunResult(
        bag="circle", mode="stereo", mapper="sjsam", odometry="none",
        agents=(AgentResult("", noisy, truth=truth, feature_counts=np.full(80, 250)),),
        landmarks=LandmarkMap(positions, covariances, np.full(200, 5)),
        dense=plate(), floor_plans=(corridor(),),
        submaps=4, loop_closures=1, frames=80, dropped={"features without depth": 2}, rejections={"outlier": 3},
        sensor_s=8.0, wall_s=2.0,
        stage_ms={"features": [40.0] * 80, "ekf": [8.0] * 80}, events=("12.3 s: <lost>",),
    )  # fmt: skip


def test_all_files_are_written_and_agree(result, tmp_path):
    summary = write_results(tmp_path, result, save_map=lambda path: path.mkdir())
    names = {p.name for p in tmp_path.iterdir()}
    assert {
        "summary.json", "trajectory.tum", "trajectory_covariance.csv", "ground_truth.tum", "landmarks.ply", "map.ply",
        "mesh.ply", "mesh.glb", "floor_plan.yaml", "floor_plan.pgm",
        "map", "map.png", "report.html",
    } == names  # fmt: skip
    assert json.loads((tmp_path / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert summary["real_time_factor"] == 4.0
    assert summary["dropped"] == 2
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "trajectory.tum").poses, result.agents[0].trajectory.poses, atol=1e-8
    )
    html = (tmp_path / "report.html").read_text()
    assert "&lt;lost&gt;" in html
    assert html.count("data:image/png;base64") == 8
    assert html.count("<iframe") == 1, "the model, to be turned"


def test_the_same_result_gives_the_same_bytes(result, tmp_path):
    for name in ("a", "b"):
        write_results(tmp_path / name, result)
    for path in (tmp_path / "a").iterdir():
        if path.name not in ("summary.json", "report.html"):  # these state the memory used
            assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_a_run_without_anything_still_has_its_files(tmp_path):
    empty = RunResult(
        "empty", "stereo", "sjsam", "none", (AgentResult("", Trajectory.from_estimates([])),), LandmarkMap.empty(),
        Surface.empty(), (), 0, 0, 0, {}, {}, 0.0, 0.0, {},
    )  # fmt: skip
    summary = write_results(tmp_path, empty)
    assert summary["end_error_m"] is None
    assert (tmp_path / "report.html").exists()


@pytest.fixture
def mapped(result):
    return replace(result, dense=Surface.empty(), floor_plans=(), events=())


def save_map(folder):
    folder.mkdir()
    (folder / "graph").write_text("a map")


def test_outputs_are_the_same_whether_begun_early_or_not(result, mapped, tmp_path):
    early_folder, late_folder = tmp_path / "early", tmp_path / "late"
    with EarlyOutput(early_folder, save_map) as early:
        early.start(mapped)
        early.write_rest(result, pictures=True)
    late_folder.mkdir()
    write_result_bag(late_folder / "result.mcap", result)
    write_results(late_folder, result, save_map)
    names = {p.relative_to(late_folder) for p in late_folder.rglob("*") if p.is_file()}
    assert names == {p.relative_to(early_folder) for p in early_folder.rglob("*") if p.is_file()}
    for name in names - {p for p in names if p.name in ("summary.json", "report.html")}:  # they state time and memory
        assert (early_folder / name).read_bytes() == (late_folder / name).read_bytes(), name


def test_the_map_is_there_as_soon_as_the_block_is_left(mapped, tmp_path):
    def give_up():
        with EarlyOutput(tmp_path / "out", save_map) as early:
            early.start(mapped)
            early._mapped.result(timeout=60)  # the user gives up while the dense model is made
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        give_up()
    assert (tmp_path / "out" / "map" / "graph").read_text() == "a map"
    assert not (tmp_path / "out" / "summary.json").exists()


def test_nothing_is_drawn_for_a_run_that_was_stopped(result, mapped, tmp_path):
    with EarlyOutput(tmp_path / "out", save_map) as early:
        early.start(mapped)
        summary = early.write_rest(result, pictures=False)
    assert summary["frames"] == result.frames
    assert {"map", "trajectory.tum", "result.mcap"} <= {p.name for p in (tmp_path / "out").iterdir()}
    assert not (tmp_path / "out" / "report.html").exists()


def test_an_error_in_the_thread_is_told(result, mapped, tmp_path):
    def fail(folder):
        raise OSError("no space left")

    with EarlyOutput(tmp_path / "out", fail) as early:
        early.start(mapped)
        with pytest.raises(OSError, match="no space left"):
            early.write_rest(result, pictures=True)
