# SPDX-License-Identifier: Apache-2.0
"""Variants of a bag: which frames are left, in what order, and that worse pictures keep their geometry."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.readings import DepthReading, ImuReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.bag_calibration import calibration_file
from slam_bags.storage.sensor_writer import IMU_FRAME, LEFT_FRAME, T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_bringup.pipeline.configuration import load_system_config
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import make_transform
from slam_core.types import ImuSample
from slam_experiments.benchmark.variants import AS_IT_IS, VARIANTS, write_variant

FRAMES, STEP_NS = 60, 100_000_000
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
RIGHT = CameraInfo(CAMERA, np.eye(3), np.column_stack([CAMERA.K, [-5.0, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Pairs and depth images 0.1 s apart, the grey tells the number, an IMU at 20 Hz, a rig that goes forward."""
    path = tmp_path_factory.mktemp("bag") / "rig.mcap"
    with BagWriter(path) as file:
        writer = SensorWriter(file)
        writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_OPTICAL, IMU_FRAME: np.eye(4)})
        for k in range(2 * FRAMES):
            stamp = 10**9 + k * STEP_NS // 2
            writer.imu(ImuSample(stamp, np.array([0.1, 0.0, 0.01 * k]), np.array([0.0, 0.0, 9.81]), IMU_FRAME))
            if k % 2 == 0:
                grey = np.full((48, 64), k, dtype=np.uint8)
                writer.stereo(stamp, grey, grey, (CameraInfo(CAMERA), RIGHT))
                depth = np.full((48, 64), 1000 + k, dtype=np.uint16)
                writer.depth(stamp, depth, CameraInfo(CAMERA), measurement="depth", amplitude=grey)
                writer.ground_truth(stamp, make_transform(np.eye(3), np.array([0.01 * k, 0.0, 0.0])))
    return path


def read(path: Path, variant: str, tmp_path: Path):
    target = tmp_path / "variant.mcap"
    write_variant(path, target, variant)
    with SensorBag(target) as opened:
        readings = list(opened.readings())
        return readings, opened.sensors[""], opened.ground_truth("")


def numbers(readings, kind=StereoReading):
    """Which frames there are, by their grey."""
    images = [r.pair.left if kind is StereoReading else r.raw.amplitude for r in readings if isinstance(r, kind)]
    return [int(image[0, 0]) // 2 for image in images]


@pytest.mark.parametrize(
    ("variant", "expected"),
    [
        (AS_IT_IS, range(60)),
        ("from frame 7", range(7, 60)),
        ("every second", range(0, 60, 2)),
        ("every third", range(0, 60, 3)),
        ("gap of 3 s", [*range(24), *range(54, 60)]),  # begins at 40 % of 5.9 s
        ("backwards", range(59, -1, -1)),
    ],
)
def test_frames_that_are_left(bag, tmp_path, variant, expected):
    readings, _, truth = read(bag, variant, tmp_path)
    assert numbers(readings) == list(expected)
    assert numbers(readings, DepthReading) == list(expected)
    assert len(truth) == FRAMES


def test_imu_goes_on_in_a_gap(bag, tmp_path):
    readings, _, _ = read(bag, "gap of 3 s", tmp_path)
    assert sum(isinstance(r, ImuReading) for r in readings) == 2 * FRAMES


def test_backwards_is_what_a_rig_measures_that_goes_the_way_back(bag, tmp_path):
    """Stamps ascend, a picture has the true pose of its instant, turn rates have the other sign, gravity stays."""
    readings, _, truth = read(bag, "backwards", tmp_path)
    stamps = [r.stamp_ns for r in readings]
    assert stamps == sorted(stamps)
    for reading in (r for r in readings if isinstance(r, StereoReading)):
        at = truth.poses[list(truth.stamps_ns).index(reading.stamp_ns)]
        assert at[0, 3] == pytest.approx(0.01 * int(reading.pair.left[0, 0]))
    samples = [r.sample for r in readings if isinstance(r, ImuReading)]
    np.testing.assert_allclose([s.angular_velocity[2] for s in samples], -0.01 * np.arange(2 * FRAMES)[::-1])
    np.testing.assert_allclose([s.linear_acceleration[2] for s in samples], 9.81)


def test_backwards_has_no_time_below_zero(tmp_path):
    """A recording whose clock begins at 0, with a truth that goes on after the last picture."""
    path, grey = tmp_path / "zero.mcap", np.zeros((48, 64), dtype=np.uint8)
    with BagWriter(path) as file:
        writer = SensorWriter(file)
        writer.extrinsics(0, {LEFT_FRAME: T_BASE_OPTICAL})
        for k in range(3):
            writer.stereo(k * STEP_NS, grey, grey, (CameraInfo(CAMERA), RIGHT))
        for k in range(6):
            writer.ground_truth(k * STEP_NS, make_transform(np.eye(3), np.array([float(k), 0.0, 0.0])))
    readings, _, truth = read(path, "backwards", tmp_path)
    assert [r.stamp_ns for r in readings] == [3 * STEP_NS, 4 * STEP_NS, 5 * STEP_NS]
    assert list(truth.stamps_ns) == [k * STEP_NS for k in range(6)]
    np.testing.assert_array_equal(truth.poses[:, 0, 3], np.arange(6)[::-1])


def test_gamma_brightens_pictures_and_leaves_depth(bag, tmp_path):
    readings, _, _ = read(bag, "gamma 0.6", tmp_path)
    pairs, depths = ([r for r in readings if isinstance(r, kind)] for kind in (StereoReading, DepthReading))
    assert pairs[20].pair.left[0, 0] == round(255 * (40 / 255) ** 0.6)
    assert depths[20].raw.image[0, 0] == 1040


def test_half_resolution_keeps_rays_and_does_not_average_over_an_edge(tmp_path):
    """A column of light stays on its ray; a depth edge inside a block of two by two pixels becomes no depth."""
    path = tmp_path / "edge.mcap"
    grey, depth = np.zeros((48, 64), dtype=np.uint8), np.full((48, 64), 1000, dtype=np.uint16)
    grey[:, 40:42] = 200
    depth[:, 33:] = 2000
    with BagWriter(path) as file:
        writer = SensorWriter(file)
        writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_OPTICAL})
        writer.stereo(10**9, grey, grey, (CameraInfo(CAMERA), RIGHT))
        writer.depth(10**9, depth, CameraInfo(CAMERA), measurement="depth", amplitude=grey)
        writer.ground_truth(10**9, np.eye(4))
    readings, sensors, _ = read(path, "half resolution", tmp_path)
    pair = next(r.pair for r in readings if isinstance(r, StereoReading))
    image = next(r.raw.image for r in readings if isinstance(r, DepthReading))
    small = sensors.left.camera
    assert pair.left.shape == (24, 32) == (small.height, small.width)
    assert pair.left[3, 20] == 200
    before = CAMERA.normalised_from_pixels(np.array([[40.5, 10.5]]))
    np.testing.assert_allclose(small.normalised_from_pixels(np.array([[20.0, 5.0]])), before, atol=1e-12)
    rectified = sensors.right.rectified.normalised_from_pixels(np.array([[20.0, 5.0]]))
    np.testing.assert_allclose(rectified, before, atol=1e-12)
    assert sensors.right.baseline == pytest.approx(RIGHT.baseline)
    assert image[:, 16].max() == 0
    assert image[5, 15] == 1000
    assert image[5, 17] == 2000


def test_jpeg_loses_a_little(bag, tmp_path, rng):
    path = tmp_path / "noise.mcap"
    grey = rng.integers(0, 255, (48, 64)).astype(np.uint8)
    with BagWriter(path) as file:
        writer = SensorWriter(file)
        writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL})
        writer.stereo(10**9, grey, grey, (CameraInfo(CAMERA), RIGHT))
        writer.ground_truth(10**9, np.eye(4))
    readings, _, _ = read(path, "JPEG quality 50", tmp_path)
    off = np.abs(readings[0].pair.left.astype(int) - grey).mean()
    assert 1.0 < off < 40.0


@pytest.mark.parametrize(("variant", "sign"), [("gap of 3 s", 1.0), ("half resolution", 1.0), ("backwards", -1.0)])
def test_the_calibration_of_a_bag_is_that_of_its_variants(bag, tmp_path, variant, sign):
    """Backwards, the last row is read first, and an IMU that was late is early."""
    source, target = tmp_path / "hall.mcap", tmp_path / "variant.mcap"
    shutil.copy(bag, source)
    calibration_file(source).write_text(
        "/**: {ros__parameters: {imu.time_offset: 0.02, calibration.sigma_scale: 0.004}}\n"
        "ekf_slam: {measurement: {readout: 0.01, sigma_readout: 0.001}}\n"
    )
    write_variant(source, target, variant)
    before, after = (load_system_config(None, path).ekf_slam for path in (source, target))
    assert before.imu.time_offset == 0.02
    assert before.measurement.readout == 0.01
    assert after.imu.time_offset == sign * 0.02
    assert after.measurement.readout == sign * 0.01
    imu = replace(before.imu, time_offset=sign * 0.02)
    assert after == replace(before, imu=imu, measurement=replace(before.measurement, readout=sign * 0.01))


def test_what_is_too_short_is_refused(tmp_path):
    path = tmp_path / "short.mcap"
    with BagWriter(path) as file:
        writer = SensorWriter(file)
        writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL})
        grey = np.zeros((48, 64), dtype=np.uint8)
        writer.stereo(10**9, grey, grey, (CameraInfo(CAMERA), RIGHT))
        writer.ground_truth(10**9, np.eye(4))
    with pytest.raises(ValueError, match="too short"):
        write_variant(path, tmp_path / "none.mcap", "from frame 7")


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_bag_of_broken_messages_is_too_short_for_every_variant(bag, tmp_path, monkeypatch, variant):
    monkeypatch.setattr(SensorBag, "readings", lambda self: iter(()))
    with pytest.raises(ValueError, match="too short"):
        write_variant(bag, tmp_path / "none.mcap", variant)


def test_every_variant_has_a_name_of_its_own():
    assert len(set(VARIANTS)) == len(VARIANTS) == 9
