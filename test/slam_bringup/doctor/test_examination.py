# SPDX-License-Identifier: Apache-2.0
"""The doctor on copies of the demo with one fault each, and on the demo itself, of which it says nothing.

``benchmarks/doctor.py`` has many more faults, and real recordings.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.cli import slam
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.examination import examine, require_stereo
from slam_bringup.doctor.finding import Finding
from slam_bringup.doctor.odometry import check_odometry
from slam_core.frame_tree import FrameTree
from slam_core.geometry import make_transform
from slam_core.types import OdometryReading

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "bags" / "demo"


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """The benchmark as a module: it knows how to fault a bag."""
    spec = importlib.util.spec_from_file_location("doctor_benchmark", ROOT / "benchmarks" / "doctor.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    module.SECONDS = 3.0
    return module


def test_of_a_good_bag_nothing_is_said() -> None:
    assert examine(DEMO) == []
    require_stereo(DEMO)


@pytest.mark.parametrize("seconds", [2.0, 5.0])
def test_of_the_beginning_of_a_good_bag_nothing_is_said(
    bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    """However many pairs there are, the depth that is compared is that of the same moment."""
    monkeypatch.setattr(bench, "SECONDS", seconds)
    assert examine(bench.copy(DEMO, tmp_path / "bag", lambda item, _: item)) == []


@pytest.mark.parametrize(
    "fault",
    [
        "left and right images exchanged", "baseline with the wrong sign", "right camera turned by 1.5 deg",
        "depth in mm given as m", "right images 20 ms late", "images offered best effort", "left camera info missing",
        "static transforms missing", "optical frames without their turn", "exposure that flickers",
    ],
)  # fmt: skip
def test_each_fault_is_named_and_what_to_do(bench: ModuleType, tmp_path: Path, fault: str) -> None:
    wanted, change = bench.FAULTS[fault]
    bag = bench.copy(DEMO, tmp_path / "bag", change, best_effort=wanted == "best effort")
    findings = examine(bag)
    assert wanted in {finding.check for finding in findings}, findings
    for finding in findings:
        assert finding.advice
        assert "\n" not in str(finding)


@pytest.mark.parametrize("command", ["run", "nodes"])
def test_a_run_that_can_never_work_says_so_at_once(bench: ModuleType, tmp_path: Path, command: str) -> None:
    bag = bench.copy(DEMO, tmp_path / "bag", bench.FAULTS["left and right images exchanged"][1])
    result = CliRunner().invoke(slam, [command, str(bag), "-o", str(tmp_path / "out")])
    assert isinstance(result.exception, ValueError)
    assert "left and right swapped" in str(result.exception)
    assert "exchange the two image topics" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_the_command_ends_with_one_where_something_is_wrong(bench: ModuleType, tmp_path: Path) -> None:
    bag = bench.copy(DEMO, tmp_path / "bag", bench.FAULTS["static transforms missing"][1])
    text, as_json = (CliRunner().invoke(slam, ["doctor", str(bag), *option]) for option in ([], ["--json"]))
    assert (text.exit_code, as_json.exit_code) == (1, 1)
    assert text.output.startswith("1. missing transforms: ")
    assert json.loads(as_json.output)[0]["check"] == "missing transforms"
    assert "--base-frame stereo_left_optical_frame" in text.output
    good = CliRunner().invoke(slam, ["doctor", str(DEMO)])
    assert good.exit_code == 0
    assert (
        "nothing wrong found in: topics, stamps, frames, calibration, stereo images, depth images, imu, odometry"
        in good.output
    )
    assert isinstance(CliRunner().invoke(slam, ["doctor"]).exception, ValueError)


def test_a_bag_that_is_mapped_in_the_cameras_own_axes_lacks_no_transform_of_that_camera(
    bench: ModuleType, tmp_path: Path
) -> None:
    bag = bench.copy(DEMO, tmp_path / "bag", bench.FAULTS["static transforms missing"][1])
    own = examine(bag, BagNames(base_frame="stereo_left_optical_frame"))
    assert [f.what for f in own if f.check == "missing transforms"] == [
        "there are no static transforms (/tf_static) to tof_optical_frame"
    ]
    assert not any("--base-frame" in f.advice for f in own)
    other = examine(DEMO, BagNames(base_frame="turret"))
    assert "to turret" in next(f.what for f in other if f.check == "missing transforms")


def test_odd_stamps_are_judged_as_a_run_judges_them(bench: ModuleType, tmp_path: Path) -> None:
    """One image an hour ahead, one twice: each is told, and nothing of what follows."""

    def change(item: Any, number: int) -> Any:
        if item.topic == "/stereo/left/image_raw":
            item.message.header.stamp.sec += 3600 * (number == 5)
            return [item] * (1 + (number == 10))
        return item

    found = {f.check: f.what for f in examine(bench.copy(DEMO, tmp_path / "bag", change))}
    assert found["odd stamps"].startswith("1 messages on /stereo/left/image_raw are left out: its stamp is 36")
    assert found["same stamp twice"].startswith("1 messages on /stereo/left/image_raw")
    assert "time goes back" not in found


def test_a_clock_that_jumps_back_is_told(bench: ModuleType, tmp_path: Path) -> None:
    def change(item: Any, number: int) -> Any:
        return item.moved(-2.0) if item.is_of("stereo/", "tof/") and number > 8 else item

    found = {f.check: f.what for f in examine(bench.copy(DEMO, tmp_path / "bag", change))}
    assert found["time goes back"].startswith("time jumped back by ")


def odometry(faults: dict[str, Any], *, standing: bool = False) -> list[Finding]:
    """Findings about ten seconds of driving at 1 m/s, 50 poses a second, with faults."""
    hz, unit = faults.get("hz", 50), np.eye(6)
    poses = []
    for k in range(10 * hz):
        T = make_transform(np.eye(3), np.array([0.0 if standing else k / hz, 0.0, 0.0]))
        T[0, 3] += 30.0 * (faults.get("jump") == k)
        covariance = faults.get("covariance", 1e-6 * (k + 1) * unit)
        poses.append(OdometryReading(10**12 + k * 10**9 // hz, T, covariance, np.zeros(6), np.zeros((6, 6))))
    evidence = Evidence("", {"odometry": "/odometry"}, {}, {}, FrameTree(), "base_link", odometry=poses)
    return list(check_odometry(evidence))


def test_an_odometry_that_says_how_good_it_is_is_well() -> None:
    assert odometry({}) == []
    assert odometry({"covariance": np.zeros((6, 6))}, standing=True) == []


@pytest.mark.parametrize(
    ("faults", "check"),
    [
        ({"covariance": np.zeros((6, 6))}, "odometry covariance"),
        ({"covariance": 1e-3 * np.eye(6)}, "odometry covariance"),
        ({"hz": 4, "covariance": 1e9 * np.eye(6)}, "odometry rate"),
        ({"jump": 30}, "odometry poses"),
    ],
)
def test_what_an_odometry_lacks_is_told(faults: dict[str, Any], check: str) -> None:
    findings = odometry(faults)
    assert check in {finding.check for finding in findings}
    assert all(finding.advice and "/odometry" in finding.what for finding in findings)
