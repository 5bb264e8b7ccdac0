# SPDX-License-Identifier: Apache-2.0
"""``slam run`` on the committed bag: accurate, complete, the same bytes every time, and clear about bad input."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ekf_slam_node.slam import EkfSlam
from mapping import quick_options
from sjsam_node.global_map import GlobalMap
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.cli import slam
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.interrupt import INTERRUPTED
from slam_core.geometry import boxminus
from slam_core.trajectory import read_covariance_csv, read_trajectory

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


def run(*arguments: str):
    return CliRunner().invoke(slam, ["run", *arguments], catch_exceptions=True)


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> list[Path]:
    folders = [tmp_path_factory.mktemp("run") / name for name in ("first", "second")]
    for folder in folders:
        result = run(str(DEMO), "-o", str(folder))
        assert result.exit_code == 0, result.output
    return folders


@pytest.mark.slow
def test_the_same_bag_gives_the_same_bytes(outputs):
    first, second = outputs
    for name in ("trajectory.tum", "trajectory_covariance.csv", "landmarks.ply", "map.ply", "map.png", "result.mcap"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


@pytest.mark.slow
def test_the_log_says_what_was_done_and_the_summary_which_sensors_were_used(outputs):
    log = (outputs[0] / "logs" / "slam.log").read_text()
    assert log.startswith("slam 0.")
    assert "submap 0 of the rig: joined" in log
    assert "ATE" in log, "the table that the run ends with"
    sensors = json.loads((outputs[0] / "summary.json").read_text())["sensors"]
    assert sensors == {"": ["stereo camera", "ToF camera for the dense model alone"]}


@pytest.mark.slow
def test_the_demo_is_mapped_to_centimetres(outputs):
    summary = json.loads((outputs[0] / "summary.json").read_text())
    assert summary["frames"] == 52
    assert summary["dropped"] == 0
    assert summary["ate_rmse_m"] < 0.02
    assert summary["end_error_m"] < 0.04
    assert summary["path_length_m"] == pytest.approx(6.45, abs=0.1)
    assert not summary["events"]


@pytest.mark.slow
def test_every_pose_has_a_covariance_that_is_one(outputs):
    trajectory = read_trajectory(outputs[0] / "trajectory.tum")
    stamps, covariances = read_covariance_csv(outputs[0] / "trajectory_covariance.csv")
    np.testing.assert_array_equal(stamps, trajectory.stamps_ns)
    assert len(stamps) == 52
    assert np.isfinite(covariances).all()
    assert np.linalg.eigvalsh(covariances).min() > 0.0


def world_from_map(folder: Path) -> np.ndarray:
    """T_world_map of a run, by the truth of its first pose."""
    estimate, truth = (read_trajectory(folder / name) for name in ("trajectory.tum", "ground_truth.tum"))
    assert estimate.stamps_ns[0] == truth.stamps_ns[0]
    return truth.poses[0] @ np.linalg.inv(estimate.poses[0])


@pytest.fixture(scope="module", params=[[], ["--localize-only"]], ids=["go on", "localize only"])
def again(request, outputs, tmp_path_factory) -> tuple[Path, Path, bool]:
    """The demo from half way on, in the map of the whole."""
    later = tmp_path_factory.mktemp("later") / "bag"
    with BagReader(DEMO) as reader, BagWriter(later) as bag:
        middle = reader.start_ns + round(0.5e9 * reader.duration_s)
        for topic, stamp, data in reader.raw():
            if stamp >= middle or "static" in topic:
                bag.write_raw(topic, reader.topics[topic].type_name, data, max(stamp, middle))
    folder = tmp_path_factory.mktemp("again") / "out"
    options = *quick_options(later.parent), *request.param
    result = run(str(later), "-o", str(folder), "--map", str(outputs[0]), *options)
    assert result.exit_code == 0, result.output
    return folder, outputs[0], not request.param


@pytest.mark.slow
def test_a_run_in_an_old_map_is_in_its_frame(again):
    folder, old, _ = again
    estimate, truth = (read_trajectory(folder / name) for name in ("trajectory.tum", "ground_truth.tum"))
    assert len(estimate) >= 20
    assert np.linalg.norm(estimate.poses[0][:3, 3]) > 1.0, "it begins where the old run was half way"
    poses = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))
    T_map_world = np.linalg.inv(world_from_map(old))
    pairs = zip(estimate.stamps_ns.tolist(), estimate.poses, strict=True)
    errors = [boxminus(T_map_world @ poses[s], T) for s, T in pairs]
    assert np.linalg.norm(np.array(errors)[:, :3], axis=1).max() < 0.05
    _, covariances = read_covariance_csv(folder / "trajectory_covariance.csv")
    nees = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)]
    assert 0.2 < np.mean(nees) / 6 < 4.0


@pytest.mark.slow
def test_the_old_map_is_read_and_never_changed(again, outputs):
    folder, old, goes_on = again
    assert (old / "map" / "manifest.json").read_bytes() == (outputs[1] / "map" / "manifest.json").read_bytes()
    sessions = {s.session for s in GlobalMap.load(folder / "map").snapshot().submaps}
    first = int(read_trajectory(old / "trajectory.tum").stamps_ns[0]) // 10**9
    assert sessions == ({first, first + 1} if goes_on else {first})


@pytest.mark.slow
def test_who_gives_up_keeps_the_map(tmp_path, monkeypatch):
    def given_up(bag, system, *, session, **_):
        asked = itertools.count()
        run_bag(bag, system, session=session, stopped=lambda: next(asked) >= 20)
        raise KeyboardInterrupt

    monkeypatch.setattr("slam_bringup.jobs.recording_run.run_bag", given_up)
    result = run(str(DEMO), "-o", str(tmp_path / "out"))
    assert result.exit_code == INTERRUPTED
    assert f"the map is in {tmp_path / 'out' / 'map'}" in result.output
    assert len(GlobalMap.load(tmp_path / "out" / "map").snapshot())


def test_localizing_needs_a_map(tmp_path):
    assert "--map" in str(run(str(DEMO), "-o", str(tmp_path / "out"), "--localize-only").exception)
    assert "not a map" in str(run(str(DEMO), "-o", str(tmp_path / "out"), "--map", str(tmp_path)).exception)
    assert not (tmp_path / "out").exists()


def test_a_mode_without_its_sensor_says_which_one_would_do(tmp_path, data_dir):
    bag = tmp_path / "kitti.mcap"
    source = data_dir / "kitti_stereo_51x2" / "KITTI_sequence_1"
    assert CliRunner().invoke(slam, ["convert", "kitti", str(source), "-o", str(bag)]).exit_code == 0
    result = run(str(bag), "-o", str(tmp_path / "out"), "--mode", "tof")
    assert isinstance(result.exception, ValueError)
    assert "try --mode stereo" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_bad_bags_and_bad_configurations_are_refused(tmp_path):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a bag")
    assert "broken.mcap" in str(run(str(broken), "-o", str(tmp_path / "out")).exception)
    config = tmp_path / "c.yaml"
    config.write_text("ekf_slam:\n  submap.max_distanc: 2.0\n")
    error = run(str(DEMO), "-o", str(tmp_path / "out"), "--config", str(config)).exception
    assert "did you mean 'submap.max_distance'" in str(error)
    config.write_text("ekf_slam: [1]\n")
    assert "must be a mapping" in str(run(str(DEMO), "-o", str(tmp_path / "out"), "--config", str(config)).exception)


def fail_after(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    process, calls = EkfSlam.process, itertools.count()

    def faulty(self: EkfSlam, *arguments):
        if next(calls) == frames:
            raise RuntimeError("something nobody has thought of")
        return process(self, *arguments)

    monkeypatch.setattr(EkfSlam, "process", faulty)


def test_what_was_mapped_before_an_error_is_written(tmp_path, monkeypatch):
    fail_after(monkeypatch, 30)
    result = run(str(DEMO), "-o", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "something nobody has thought of" in result.output
    assert "holds what was mapped until then" in result.output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert "RuntimeError" in summary["failure"]
    assert summary["frames"] == 30
    assert summary["landmarks"] > 50
    assert len(read_trajectory(tmp_path / "out" / "trajectory.tum")) == 30
    assert (tmp_path / "out" / "map.ply").stat().st_size > 1000


def test_an_error_before_the_first_frame_is_raised_and_writes_nothing(tmp_path, monkeypatch):
    fail_after(monkeypatch, 0)
    assert isinstance(run(str(DEMO), "-o", str(tmp_path / "out")).exception, RuntimeError)
    assert not (tmp_path / "out").exists()
