# SPDX-License-Identifier: Apache-2.0
"""Range-bearing logs: read, mapped by every method, and refused where they are broken."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bringup.cli import slam
from slam_experiments.planar.ekf import PlanarEkf
from slam_experiments.planar.log import PlanarLog, RobotLog
from slam_experiments.planar.mapping import METHODS, accuracy, dead_reckoning, map_log
from slam_experiments.planar.output import landmark_error
from slam_experiments.planar.readers import read_log
from slam_simulation.planar import PlanarRun, PlanarWorldConfig, simulate_planar

WORLD = PlanarWorldConfig(samples=150, laps=2.2)


def robot_log(run: PlanarRun, name: str = "robot") -> RobotLog:
    c = run.config
    Q = np.diag(np.array([c.sigma_step, c.sigma_step, c.sigma_turn]) ** 2)
    return RobotLog(
        name,
        np.arange(float(len(run.poses))),
        run.odometry,
        np.broadcast_to(Q, (len(run.odometry), 3, 3)),
        tuple(np.column_stack([o.ranges, o.bearings]) for o in run.observations),
        tuple(o.ids for o in run.observations),
        run.poses,
    )


def planar_log(seed: int) -> PlanarLog:
    run = simulate_planar(WORLD, np.random.default_rng(seed))
    landmarks = dict(enumerate(run.landmarks))
    return PlanarLog("simulated", (robot_log(run),), WORLD.sigma_range, WORLD.sigma_bearing, landmarks)


@pytest.mark.parametrize("method", ["ekf", "sam", "submaps"])
def test_every_method_maps_and_beats_dead_reckoning(method):
    log = planar_log(1)
    result = map_log(log, method)
    found = accuracy(log.robots[0], result.paths[0])
    alone = dead_reckoning(log.robots[0])[:, :2] - log.robots[0].truth[:, :2]
    assert found["ate_m"] < 0.4 * np.sqrt(np.mean(np.sum(alone**2, axis=1)))
    assert landmark_error(log, result, "known") < 0.2
    assert result.rejected <= 2
    if method != "submaps":
        assert found["anees"] < 4.0
    if result.chi2 is not None:
        assert 0.8 < result.chi2 / result.degrees_of_freedom < 1.2


def test_names_that_are_found_serve_every_method():
    """Noise in which neighbours are mistaken step by step; the log's own names are not looked at."""
    world = replace(WORLD, samples=100, landmarks=20, sigma_range=0.15, sigma_turn=0.05)
    run = simulate_planar(world, np.random.default_rng(1))
    log = PlanarLog("simulated", (robot_log(run),), world.sigma_range, world.sigma_bearing)
    nameless = replace(log.robots[0], ids=tuple(np.zeros_like(ids) for ids in log.robots[0].ids))
    for method in METHODS:
        known, found = (
            accuracy(log.robots[0], map_log(asked, method, association).paths[0])["rmse_m"]
            for asked, association in ((log, "known"), (replace(log, robots=(nameless,)), "hypotheses"))
        )
        assert found < 1.5 * known


def test_smoothing_is_better_than_filtering():
    log = planar_log(2)
    errors = {m: accuracy(log.robots[0], map_log(log, m).paths[0])["rmse_m"] for m in ("ekf", "sam")}
    assert errors["sam"] < errors["ekf"]


def test_wrong_names_are_left_out():
    log = planar_log(3)
    robot = log.robots[0]
    ids = [i.copy() for i in robot.ids]
    swapped = 0
    for k in range(40, 140, 5):
        if len(ids[k]) > 1:
            ids[k][:2] = ids[k][1::-1]
            swapped += 2
    wrong = replace(log, robots=(replace(robot, ids=tuple(ids)),))
    result = map_log(wrong, "sam")
    assert 0.7 * swapped <= result.rejected <= 3 * swapped
    assert accuracy(robot, result.paths[0])["rmse_m"] < 0.15


def test_robots_are_joined_by_their_landmarks():
    base = planar_log(4)
    first = base.robots[0]
    half = len(first.stamps) // 2
    parts = []
    for name, steps in (("a", slice(0, half)), ("b", slice(half, None))):
        count = len(first.stamps[steps])
        begin = steps.start or 0
        parts.append(RobotLog(
            name, first.stamps[steps], first.motions[begin : begin + count - 1],
            first.motion_covariances[begin : begin + count - 1], first.observations[steps], first.ids[steps],
            first.truth[steps],
        ))  # fmt: skip
    log = replace(base, robots=tuple(parts))
    result = map_log(log, "sam")
    for robot, path in zip(log.robots, result.paths, strict=True):
        assert accuracy(robot, path)["rmse_m"] < 0.15
    with pytest.raises(ValueError, match="--robot"):
        map_log(log, "ekf")


def gtsam_text(run: PlanarRun) -> str:
    c, lines = run.config, []
    for k, o in enumerate(run.observations):
        if k:
            d = " ".join(f"{v:.9f}" for v in run.odometry[k - 1])
            lines.append(f"ODOMETRY {k - 1} {k} {d} {c.sigma_step**2} 0 0 {c.sigma_step**2} 0 {c.sigma_turn**2}")
        for i, r, b in zip(o.ids, o.ranges, o.bearings, strict=True):
            lines.append(f"LANDMARK {k} {1000 + i} {r * np.cos(b):.9f} {r * np.sin(b):.9f} 0.0025 0 0.0025")
    return "\n".join(lines) + "\n"


def test_the_command_maps_a_gtsam_file(tmp_path):
    run = simulate_planar(WORLD, np.random.default_rng(5))
    (tmp_path / "log.txt").write_text(gtsam_text(run))
    out = tmp_path / "out"
    result = CliRunner().invoke(slam, ["plane", str(tmp_path / "log.txt"), "-o", str(out)])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["landmarks"] == len(np.unique(np.concatenate([o.ids for o in run.observations])))
    path = np.genfromtxt(out / "path_robot.csv", delimiter=",", names=True)
    moved = run.poses[:, :2] - run.poses[0, :2]
    assert np.abs(np.hypot(path["x_m"], path["y_m"]) - np.linalg.norm(moved, axis=1)).max() < 0.3
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")


def test_filterpys_filter_is_chosen_and_has_our_standard_filters_path(tmp_path):
    run = simulate_planar(WORLD, np.random.default_rng(5))
    (tmp_path / "log.txt").write_text(gtsam_text(run))
    command = ["plane", str(tmp_path / "log.txt"), "--filter", "filterpy", "-o", str(tmp_path / "out")]
    result = CliRunner().invoke(slam, [*command, "--method", "ekf"])
    assert result.exit_code == 0, result.output
    path = np.genfromtxt(tmp_path / "out" / "path_robot.csv", delimiter=",", names=True)
    read = read_log(tmp_path / "log.txt")
    standard = map_log(read, "ekf", make_filter=StandardEkf).paths[0].poses
    np.testing.assert_allclose(np.column_stack([path["x_m"], path["y_m"]]), standard[:, :2], atol=2e-4)
    assert np.abs(map_log(read, "ekf").paths[0].poses - standard).max() > 1e-3  # the default is another error state
    with pytest.raises(ValueError, match="--method ekf"):
        CliRunner().invoke(slam, command, catch_exceptions=False)


class StandardEkf(PlanarEkf):
    """Our filter in filterpy's error state."""

    def __init__(self, config, pose, pose_covariance):
        super().__init__(replace(config, error="standard"), pose, pose_covariance)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("log.txt", "nothing of the kind\n", "no ODOMETRY"),
        ("log.txt", "ODOMETRY 0 1 x 0 0 1 0 0 1 0 1\n", "line 1"),
        ("log.csv", "", "no known range-bearing log"),
        ("log.mat", "not matlab", "log.mat"),
    ],
)
def test_a_broken_log_says_what_is_wrong(tmp_path, name, content, reason):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=reason):
        read_log(tmp_path / name)


@pytest.mark.data
def test_five_real_robots_share_one_map(data_dir):
    log = read_log(data_dir / "mrclam_6")
    short = replace(log, robots=tuple(_first(robot, 400) for robot in log.robots))
    result = map_log(short, "sam")
    for robot, path in zip(short.robots, result.paths, strict=True):
        assert accuracy(robot, path)["ate_m"] < 0.3
    assert len(result.landmarks) == 15


def _first(robot: RobotLog, steps: int) -> RobotLog:
    return RobotLog(
        robot.name, robot.stamps[:steps], robot.motions[: steps - 1], robot.motion_covariances[: steps - 1],
        robot.observations[:steps], robot.ids[:steps], robot.truth[:steps],
    )  # fmt: skip
