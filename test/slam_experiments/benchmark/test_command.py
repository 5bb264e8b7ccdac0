# SPDX-License-Identifier: Apache-2.0
"""``slam benchmark`` on a small simulated bag: figures, resumption, the comparison, and clear lines."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_bringup.cli import slam
from slam_core.camera import Camera, CameraInfo
from slam_experiments.benchmark.recording_sets import sets_of
from slam_experiments.benchmark.variants import write_variant

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
INFO = CameraInfo(Camera(64, 48, 50.0, 50.0, 31.5, 23.5))


def benchmark(*arguments: object):
    return CliRunner().invoke(slam, ["benchmark", *map(str, arguments)])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with 18 frames of the demo."""
    folder = tmp_path_factory.mktemp("data")
    write_variant(DEMO, folder / "demo.mcap", "every third")
    return folder


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "benchmark"
    chosen = ["--variants", "as it is", "--variants", "every second"]
    return output, benchmark(data, "-o", output, *chosen, "--peers", "--orbslam3", sys.executable), chosen


def test_figures_of_all_programs_and_variants(finished):
    output, result, _ = finished
    assert result.exit_code == 0, result.output
    rows = json.loads((output / "benchmark.json").read_text())
    assert [(r["recording"], r["variant"], r["program"]) for r in rows] == [
        ("demo", variant, program) for variant in ("as it is", "every second") for program in ("ours", "SIFT + PnP")
    ]
    own = rows[0]
    assert own["frames"] == 18
    assert own["coverage"] == 1.0
    assert own["ate_mm"] < 30.0
    assert own["ate_mm"] < rows[1]["ate_mm"] * 1.5
    assert 0.05 < own["anees"] < 6.0
    assert rows[2]["frames"] == 9
    assert "| demo | ours, alone | 2 |" in (output / "benchmark.md").read_text()
    assert len((output / "benchmark.csv").read_text().splitlines()) == 5


def test_a_program_that_is_missing_is_named_with_what_to_install(finished):
    _, result, _ = finished
    assert "ORB-SLAM3 is left out" in result.stderr
    assert "pip install orbslam3-python" in result.stderr


def test_a_second_run_does_only_what_is_missing(data, finished):
    output, _, chosen = finished
    kept = {path: path.stat().st_mtime_ns for path in output.glob("cache/*/result.json")}
    assert len(kept) == 6  # two bags, two of ours, two of the peer
    lost = next(path for path in kept if path.parent.name.startswith("pnp"))
    shutil.rmtree(lost.parent)
    before = json.loads((output / "benchmark.json").read_text())
    result = benchmark(data, "-o", output, *chosen, "--peers", "--orbslam3", "no-such-python")
    assert result.exit_code == 0, result.output
    again = json.loads((output / "benchmark.json").read_text())
    assert [_without_time(row) for row in again] == [_without_time(row) for row in before]
    changed = [path for path, time in kept.items() if path.stat().st_mtime_ns != time]
    assert changed == [lost]


def _without_time(row):
    return {name: value for name, value in row.items() if name != "ms_per_frame"}


def test_against_the_state_before(data, finished, tmp_path):
    output, _, chosen = finished
    rows = json.loads((output / "benchmark.json").read_text())
    for factor, code, verdict in ((1.0, 0, "same"), (2.0, 0, "better"), (0.5, 1, "WORSE")):
        old = tmp_path / f"old_{factor}.json"
        old.write_text(json.dumps([{**row, "ate_mm": factor * row["ate_mm"]} for row in rows]))
        result = benchmark(data, "-o", output, *chosen, "--peers", "--orbslam3", "no-such-python", "--against", old)
        assert result.exit_code == code, result.output
        assert verdict in result.output
        assert f"geometric mean of the ratios {1 / factor:.3f}" in " ".join(result.output.split())


def test_what_cannot_be_compared_is_refused_before_anything_runs(data, finished, tmp_path):
    rows = json.loads((finished[0] / "benchmark.json").read_text())
    keys = ("recording", "variant", "program", "run", "ate_mm")
    broken = [[{k: v for k, v in row.items() if k != key} for row in rows] for key in keys]
    others = [{**row, "recording": "hall"} for row in rows]
    for old, told in (*((b, "is no benchmark.json") for b in broken), (others, "nothing to compare")):
        path, output = tmp_path / "old.json", tmp_path / "out"
        path.write_text(json.dumps(old))
        result = benchmark(data, "-o", output, *finished[2], "--against", path)
        assert result.exit_code != 0
        assert told in f"{result.output} {result.exception}"
        assert not output.exists()


def test_a_bad_recording_fails_alone(data, finished, tmp_path):
    folder, output = tmp_path / "data", tmp_path / "out"
    folder.mkdir()
    shutil.copy(data / "demo.mcap", folder)
    (folder / "broken.mcap").write_bytes(b"no bag")
    with BagWriter(folder / "aimless.mcap") as bag:
        writer, grey = SensorWriter(bag), np.zeros((48, 64), dtype=np.uint8)
        writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL})
        writer.stereo(10**9, grey, grey, (INFO, INFO))
    result = benchmark(folder, "-o", output, "--variants", "as it is")
    assert result.exit_code == 0, result.output
    rows = {row["recording"]: row for row in json.loads((output / "benchmark.json").read_text())}
    assert "no ground truth" in rows["aimless"]["failed"]
    assert "broken" in rows["broken"]["failed"]
    assert rows["demo"]["ate_mm"] == json.loads((finished[0] / "benchmark.json").read_text())[0]["ate_mm"]
    opened = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam_experiments.benchmark.recording_sets._bag", lambda path: opened.append(path.stem))
        sets_of(folder, ["demo"])
    assert opened == ["demo"]


def test_wrong_input_is_one_clear_line(data, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    bad = tmp_path / "bad.json"
    bad.write_text("{}")
    for arguments, told in (
        ((empty,), "neither a bag nor a public recording"),
        ((data, "--only", "hall"), "no recording 'hall' in the data folder; there are demo"),
        ((data, "--against", bad), "is no benchmark.json of slam benchmark"),
    ):
        result = benchmark(*arguments, "-o", tmp_path / "out")
        assert result.exit_code != 0
        assert told in f"{result.output} {result.exception}"
