# SPDX-License-Identifier: Apache-2.0
"""``slam calibrate``: the files it writes feed the drivers, and bad input ends with one clear error."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from demo_parts import cut
from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_bringup.cli import slam
from slam_bringup.commands.calibrate import command
from slam_bringup.pipeline.configuration import load_system_config
from slam_core.camera import Camera
from slam_core.camera_info import read_camera_info
from slam_core.geometry import make_transform, rotation_from_quaternion
from slam_core.messages import rectified_info


def run(*arguments: str) -> str:
    result = CliRunner().invoke(command, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.data
def test_stereo_writes_what_the_drivers_read(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "calib_opencv_left_right"
    patterns = [str(folder / f"{side}[01][0-9].jpg") for side in ("left", "right")]
    printed = run("stereo", *patterns, "--board", "chessboard:9x6:0.025", "-o", str(tmp_path))
    assert "| fx |" in printed
    left, right = (read_camera_info(tmp_path / f"{side}.yaml") for side in ("left", "right"))
    np.testing.assert_array_equal(left.info.P[:, :3], right.info.P[:, :3])
    assert right.info.baseline == pytest.approx(0.0832, abs=0.001)
    assert 0.0 < left.standard_deviations["fx"] < 1.0
    extrinsics = yaml.safe_load((tmp_path / "extrinsics.yaml").read_text())
    T = make_transform(rotation_from_quaternion(np.array(extrinsics["rotation_xyzw"])), extrinsics["translation_m"])
    np.testing.assert_allclose(T, make_transform(np.eye(3), np.array([right.info.baseline, 0.0, 0.0])), atol=1e-9)
    written = json.loads((tmp_path / "summary.json").read_text())
    assert np.linalg.norm(np.array(written["T_left_right"])[:3, 3]) == pytest.approx(right.info.baseline)
    assert written["rms_px"] < 0.45
    expected = {"left.yaml", "right.yaml", "extrinsics.yaml", "report.md", "summary.json", "residuals.png"}
    assert {path.name for path in tmp_path.iterdir()} == {
        *expected,
        "board_poses.png",
        "calibration.yaml",
        "extrinsics.urdf",
        ".slam.json",
    }
    assert "left01.jpg | 54 | 54" in (tmp_path / "report.md").read_text()


@pytest.mark.data
def test_mono_and_tof_pairs(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "calib_opencv_left_right"
    board = ("--board", "chessboard:9x6:0.025")
    run("mono", str(folder / "left0[1-9].jpg"), *board, "-o", str(tmp_path / "mono"), "--model", "plumb_bob4")
    assert read_camera_info(tmp_path / "mono" / "camera.yaml").info.camera.distortion[4] == 0.0
    patterns = [str(folder / f"{side}0[1-9].jpg") for side in ("left", "right")]
    stereo = ("stereo", *patterns, *board, "-o", str(tmp_path / "stereo"))
    run(*stereo, "--model", "plumb_bob,plumb_bob4")
    tof_run = ("stereo-tof", *patterns, *board, "--model", "plumb_bob,plumb_bob4", "-o", str(tmp_path / "tof"))
    run(*tof_run, "--left-info", str(tmp_path / "stereo" / "left.yaml"))
    tof = read_camera_info(tmp_path / "tof" / "tof.yaml").info
    np.testing.assert_array_equal(tof.P[:, :3], tof.camera.K)
    extrinsics = yaml.safe_load((tmp_path / "tof" / "extrinsics.yaml").read_text())
    assert extrinsics["child_frame"] == "tof_optical_frame"
    # The second camera stands on the x axis of the rectified left frame.
    baseline = read_camera_info(tmp_path / "stereo" / "right.yaml").info.baseline
    np.testing.assert_allclose(extrinsics["translation_m"], [baseline, 0.0, 0.0], atol=1e-9)


@pytest.mark.data
def test_bad_input_is_refused_and_leaves_nothing(data_dir: Path, tmp_path: Path) -> None:
    folder, out = data_dir / "calib_opencv_left_right", tmp_path / "out"
    left, right = str(folder / "left0[1-5].jpg"), str(folder / "right0[1-5].jpg")
    cases = [
        (("mono", left, "--board", "chessboard:9x5:0.025"), "9x6 inner corners"),
        (("mono", str(folder / "left0[1-3].jpg"), "--board", "chessboard:9x6:0.025"), "3 pictures, at least 4"),
        (("mono", left, "--board", "chessboard"), "chessboard:9x6:0.025"),
        (("mono", left, "--board", "chessboard:9x6:0.025", "--model", "wide"), "unknown lens model 'wide'"),
        (("stereo", right, left, "--board", "chessboard:9x6:0.025"), "swapped"),
        (("stereo", left, right, "--board", "chessboard:9x6:0.025", "--model", "none,none,none"), "3 lens models"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            run(*arguments, "-o", str(out))
    assert not out.exists()


@pytest.mark.data
def test_refine_writes_the_offset_of_the_imu_that_the_next_run_knows(data_dir: Path, tmp_path: Path) -> None:
    """The IMU's stamps of a real recording, 20 ms too early."""
    late_ns, source, copy, out = 20_000_000, data_dir / "euroc_mh01_10hz", tmp_path / "mh01", tmp_path / "out"
    shutil.copytree(source, copy, copy_function=os.symlink)
    (table,) = copy.rglob("imu0/data.txt")
    early = re.sub(r"(?m)^\d+", lambda stamp: str(int(stamp[0]) - late_ns), table.read_text())
    table.unlink()  # a link
    table.write_text(early)
    bag = tmp_path / "mh01.mcap"
    slam(["convert", "euroc", str(copy), "-o", str(bag)], standalone_mode=False)
    assert "to be added to the IMU's stamps" in run("refine", str(bag), "-o", str(out))
    imu = load_system_config(None, None, read_rig_calibration([out]).parameters).ekf_slam.imu
    assert imu.time_offset == pytest.approx(0.02, abs=1e-3)
    assert 1e-4 < imu.sigma_time_offset < 1e-3


@pytest.mark.data
def test_refine_writes_a_readout_that_the_next_run_knows(data_dir: Path, tmp_path: Path) -> None:
    whole, bag, out = tmp_path / "whole.mcap", tmp_path / "office.mcap", tmp_path / "out"
    slam(["convert", "rgbd", str(data_dir / "hololens_office_120"), "-o", str(whole)], standalone_mode=False)
    cut(bag, 0.0, 0.5, whole)  # one filter for twice the way takes four times as long
    known = tmp_path / "office.calibration.yaml"
    known.write_text("/**:\n  ros__parameters:\n    calibration.sigma_scale: 0.004\n")
    assert "read out within" in run("refine", str(bag), "-o", str(out))
    filter_config = load_system_config(None, None, read_rig_calibration([out]).parameters).ekf_slam
    assert filter_config.measurement.readout == pytest.approx(0.011, abs=0.003)
    assert 0.0005 < filter_config.measurement.sigma_readout < 0.002
    assert filter_config.calibration.sigma_scale == 0.004
    assert read_camera_info(out / "tof.yaml").info.camera.width == 540


def test_refine_writes_the_bend_of_a_depth_camera_that_the_next_run_takes_out(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    bag, out, bend, camera = (
        tmp_path / "corner.mcap",
        tmp_path / "out",
        0.06,
        Camera(160, 120, 146.0, 146.0, 80.0, 60.0),
    )
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height)[:, None] - camera.cy) / camera.fy
    with BagWriter(bag) as writer:
        sensors = SensorWriter(writer)
        sensors.extrinsics(0, {TOF_FRAME: T_BASE_OPTICAL})
        for number in range(30):
            left, right = rng.uniform(0.3, 0.7, 2)
            true = 2.5 / np.maximum(1.0 + left * x + 0.05 * y, 1.0 - right * x - 0.05 * y)
            measured = true / (1.0 + bend * (x**2 - np.mean(x**2))) + rng.normal(0.0, 0.005, true.shape)
            info, stamp = rectified_info(camera), 200_000_000 * number
            sensors.depth(stamp, measured.astype(np.float32), info, measurement="depth")
    assert "depth is bent along columns by" in run("refine", str(bag), "-o", str(out))
    found = load_system_config(None, None, read_rig_calibration([out]).parameters).tof_driver.depth_distortion
    assert found.sigma_columns < 0.005
    assert found.columns == pytest.approx(bend, abs=3.0 * found.sigma_columns)
    written = (out / "calibration.yaml").read_text()
    assert "depth_distortion.sigma_columns" in written
    assert "depth_distortion.sigma_rows" not in written, "rows are straight"
    assert found.rows == 0.0
