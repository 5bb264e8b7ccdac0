# SPDX-License-Identifier: Apache-2.0
"""What the sensors add: noise of the stated size, wrapping, saturation, flying pixels, blur, and the IMU's readings."""

from dataclasses import replace

import numpy as np
import pytest

from slam_core.camera import CameraInfo
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, invert_transform, make_transform, so3_exp, transform_points
from slam_simulation import Simulator
from slam_simulation.rendering.raycaster import camera_rays
from slam_simulation.scenario import Scenario
from slam_simulation.sensors.calibrated_pair import CalibratedPair, calibrated_pair
from slam_simulation.sensors.imu import GRAVITY, ImuSensor, ImuSensorConfig, ideal_reading
from slam_simulation.sensors.stereo_sensor import (
    StereoSensor,
    StereoSensorConfig,
    camera_twist,
    expose,
    motion_blur,
)
from slam_simulation.sensors.tof_sensor import TofSensor, TofSensorConfig
from slam_simulation.trajectory import StationPath, rig_twist
from slam_simulation.world.surface_table import SurfaceTable, compile_world
from slam_simulation.world.world import Material, Rectangle, World


def wall_at(*distances: float) -> SurfaceTable:
    """Walls across the x axis; each farther one is seen to the left of the edge of the nearer one."""
    world = World(1)
    lamp = Rectangle([1.0, -0.2, 4.0], [0.4, 0.0, 0.0], [0.0, -0.4, 0.0], Material("metal"))
    world.add_lamp(lamp, 1.0)
    for k, x in enumerate(distances):
        left = 8.0 if k == len(distances) - 1 else 0.0
        world.add(Rectangle([x, left, -5.0], [0.0, -8.0 - left, 0.0], [0.0, 0.0, 10.0], Material("plaster")))
    return compile_world(world)


@pytest.fixture(scope="module")
def tof() -> TofSensor:
    return TofSensor(replace(TofSensorConfig(), offset_noise=0.0, tilt_deg=(0.0, 0.0, 0.0), position=(0, 0, 0)), seed=1)


def middle(image: np.ndarray) -> np.ndarray:
    return image[80:124, 80:124]


def true_range(tof: TofSensor, distance: float) -> np.ndarray:
    return np.asarray(distance * np.sqrt(1.0 + (tof.rays.rays[..., :2] ** 2).sum(axis=-1)))


@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_tof_noise_is_that_of_the_amplitude(tof: TofSensor, distance: float) -> None:
    world, rng = wall_at(distance), np.random.default_rng(0)
    images = [tof.capture(world, np.eye(4), rng, None) for _ in range(8)]
    error = np.stack([middle(i.range) - middle(true_range(tof, distance)) for i in images])
    stated = tof.range_sigma(np.median([middle(i.amplitude) for i in images]))
    assert error.std() == pytest.approx(float(stated), rel=0.08)


def test_tof_noise_is_3_mm_at_2_m_on_the_reference(tof: TofSensor) -> None:
    c = tof.config
    amplitude = c.amplitude_scale * c.reference_reflectance / 2.0**2
    assert float(tof.range_sigma(np.array(amplitude))) == pytest.approx(0.003)


def test_tof_range_wraps_at_the_ambiguity(tof: TofSensor) -> None:
    images = tof.capture(wall_at(9.0), np.eye(4), np.random.default_rng(0), None)
    assert np.median(middle(images.range)) == pytest.approx(9.0 - 7.5, abs=0.05)


def test_tof_saturates_near_a_wall(tof: TofSensor) -> None:
    images = tof.capture(wall_at(0.35), np.eye(4), np.random.default_rng(0), None)
    assert (middle(images.range) == 0.0).all()
    assert (middle(images.amplitude) == np.float32(tof.config.saturation)).all()


def test_flying_pixels_lie_between_the_surfaces(tof: TofSensor) -> None:
    images = tof.capture(wall_at(2.0, 3.0), np.eye(4), np.random.default_rng(0), None)
    strip = middle(images.range)
    between = (strip > 2.1) & (strip < 2.9)
    assert 5 < between.sum() < 3 * strip.shape[0]


def test_image_noise_is_shot_and_read_noise() -> None:
    config, rng = StereoSensorConfig(), np.random.default_rng(0)
    for level in (0.2, 0.6):
        image = expose(np.full((400, 400), level, np.float32), 1.0, config, rng).astype(float)
        variance = 255 * level / config.electrons_per_level + config.read_noise**2 + 1 / 12
        assert image.mean() == pytest.approx(255 * level, abs=0.05)
        assert image.var() == pytest.approx(variance, rel=0.03)


def test_exposure_control_reaches_the_wanted_brightness(scenario: Scenario, simulator: Simulator) -> None:
    frames = list(simulator.run(2))
    assert frames[0].left is not None
    assert frames[0].left.mean() / 255 == pytest.approx(StereoSensorConfig().brightness, abs=0.08)


def test_motion_blur_smears_along_the_motion() -> None:
    camera = StereoSensor(StereoSensorConfig(), rectified=True).stereo.camera
    rays, image = camera_rays(camera), np.zeros((480, 640), np.float32)
    image[:, 320] = 1.0
    depth = np.full((480, 640), 2.0, np.float32)
    turned = motion_blur(image, depth, rays, np.array([0, 0, 0, 0, 0.02, 0]))
    row = turned[240]
    assert row.sum() == pytest.approx(1.0, abs=0.05)
    assert (row > 0.01).sum() == pytest.approx(0.02 * 283 + 1, abs=2)
    np.testing.assert_array_equal(motion_blur(image, depth, rays, np.zeros(6)), image)


def test_camera_twist_is_that_of_its_place(simulator: Simulator) -> None:
    """Against the camera's own poses, differentiated."""
    t, step, T_rig_camera = 0.9, 1e-4, simulator.stereo.T_rig_raw[1]
    twist = camera_twist(rig_twist(simulator.path, t), T_rig_camera)
    before, now, after = (simulator.path.pose(t + s) @ T_rig_camera for s in (-step, 0, step))
    velocity = now[:3, :3].T @ (after - before)[:3, 3] / (2 * step)
    np.testing.assert_allclose(twist[:3], velocity, atol=1e-4)


def test_camera_infos_share_one_rectified_frame() -> None:
    sensor = StereoSensor(StereoSensorConfig())
    left, right = sensor.infos
    assert left.baseline == 0.0
    assert right.baseline == pytest.approx(0.12)
    assert left.rectified == right.rectified
    T_rig_left = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))
    for info, T, offset in zip(sensor.infos, sensor.T_rig_raw, (0.0, 0.12), strict=True):
        np.testing.assert_allclose(T[:3, :3] @ info.R.T, T_rig_left[:3, :3], atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], [0.0, -offset, 0.0], atol=1e-12)


def test_resting_imu_feels_gravity() -> None:
    path = StationPath(np.array([[1.0, 2.0, 1.2, 0.7, 0.0]]), 5.0)
    rate, force = ideal_reading(path, 2.0)
    np.testing.assert_allclose(rate, 0.0, atol=1e-12)
    np.testing.assert_allclose(force, [0.0, 0.0, GRAVITY], atol=1e-6)


def test_imu_integrates_to_the_true_turn(scenario: Scenario) -> None:
    """Angular velocity summed over the whole loop turns the rig back to where it was."""
    sensor = ImuSensor(replace(ImuSensorConfig(), gyro_noise=0.0, gyro_bias=0.0, rate=500.0), (1,))
    path = scenario.path()
    samples = sensor.read(path, 0.0, path.duration, 0)
    R = path.pose(0.0)[:3, :3]
    for sample in samples:
        R = R @ so3_exp(sample.angular_velocity / 500.0)
    np.testing.assert_allclose(R, path.pose(path.duration)[:3, :3], atol=2e-3)


def test_imu_noise_and_bias_are_as_stated(scenario: Scenario) -> None:
    config = replace(ImuSensorConfig(), gyro_bias=0.1, gyro_noise=0.01)
    sensor = ImuSensor(config, (2,))
    ideal = [ideal_reading(scenario.path(), k / 100)[0] for k in range(1, 201)]
    samples = sensor.read(scenario.path(), 0.0, 2.0, 0)
    error = np.array([s.angular_velocity for s in samples]) - ideal
    np.testing.assert_allclose(error.mean(axis=0), sensor.gyro_bias, atol=0.003)
    assert error.std(axis=0) == pytest.approx(0.01, rel=0.2)


def disparity_error(pair: CalibratedPair, infos: tuple[CameraInfo, ...]) -> FloatArray:
    """Error (n,) px of the disparities of points at 3 m, rectified as the camera infos say."""
    rays = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5)), axis=-1).reshape(-1, 2)
    points, u = 3.0 * np.column_stack([rays, np.ones(len(rays))]), []
    for camera, T, info in zip(pair.cameras, pair.T_rectified_raw, infos, strict=True):
        pixels = camera.project(transform_points(invert_transform(T), points))
        xy = info.camera.normalised_from_pixels(pixels)
        turned = np.column_stack([xy, np.ones(len(xy))]) @ info.R.T
        u.append(info.P[0, 0] * turned[:, 0] / turned[:, 2])
    return u[0] - u[1] + infos[1].P[0, 3] / 3.0


def test_a_calibration_from_pictures_errs_by_hundredths_of_a_pixel_and_says_so() -> None:
    config = StereoSensorConfig()
    infos = StereoSensor(config).infos
    exact = calibrated_pair(infos, config.baseline, 0, 0.15, np.random.default_rng(0))
    np.testing.assert_allclose(disparity_error(exact, infos), 0.0, atol=1e-9)
    assert exact.error.is_exact
    errors, nees = [], []
    for seed in range(6):
        pair = calibrated_pair(infos, config.baseline, 20, 0.15, np.random.default_rng(seed))
        wrong = disparity_error(pair, infos)
        errors.append(wrong)
        disparity = -infos[1].P[0, 3] / 3.0
        nees.append((np.mean(wrong) / disparity / pair.error.lengths.sigma_scale) ** 2)
    assert 0.01 < np.sqrt(np.mean(np.square(errors))) < 0.1
    assert 0.1 < np.mean(nees) < 2.5
