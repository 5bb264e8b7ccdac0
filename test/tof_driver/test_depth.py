# SPDX-License-Identifier: Apache-2.0
"""The whole way from a raw image to a depth image, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam_core.camera import Camera
from slam_core.config import from_mapping
from tof_driver.depth import DepthConfig, DepthProcessor, normalise
from tof_driver.noise import NoiseConfig, range_sigma
from tof_driver.points import depth_cloud

LENS = Camera(204, 204, 280.0, 281.0, 102.3, 100.2, "plumb_bob", (-0.38, 0.2, 0.001, -0.0008, 0.0))
PLAIN = Camera(160, 120, 145.0, 145.0, 79.5, 59.5)
DEPTH_CAMERA = from_mapping(DepthConfig, {"measurement": "depth"})


def wall(
    camera: Camera, normal: tuple[float, float, float] = (0.3, 0.2, 1.0), distance: float = 2.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Range along the ray and depth along z of a wall, shape (height, width)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    xy = camera.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    rays = np.column_stack([xy, np.ones(len(xy))])
    depth = distance / (rays @ np.array(normal))
    shape = camera.height, camera.width
    return (depth * np.linalg.norm(rays, axis=1)).reshape(shape), depth.reshape(shape)


def test_range_through_a_lens_becomes_depth_with_honest_sigma(rng: np.random.Generator) -> None:
    processor = DepthProcessor(DepthConfig(), LENS)
    distance, _ = wall(LENS)
    _, truth = wall(processor.output_camera)
    amplitude = 600.0 / distance**2
    sigma = range_sigma(processor.config.noise, distance.astype(np.float32), amplitude.astype(np.float32))
    errors = []
    for stamp in range(4):
        noisy = distance + sigma * rng.normal(size=distance.shape)
        image = processor.process(stamp, noisy.astype(np.float32), amplitude, amplitude)
        assert image.stamp_ns == stamp
        assert image.camera.is_rectified
        errors.append(((image.depth - truth) / image.sigma)[np.isfinite(image.depth)])
    normalised = np.concatenate(errors)
    assert len(normalised) > 0.98 * 4 * truth.size
    assert np.std(normalised) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(normalised)) < 0.02


def test_depth_camera_sigma_grows_with_depth_and_reasons_are_counted(rng: np.random.Generator) -> None:
    processor = DepthProcessor(DEPTH_CAMERA, PLAIN)
    raw = rng.uniform(2000, 2005, (PLAIN.height, PLAIN.width)).astype(np.uint16)
    raw[40:60, 50:70] = 0
    image = processor.process(0, raw)
    known = np.isfinite(image.depth)
    np.testing.assert_allclose(image.depth[known], 1e-3 * raw[known], rtol=1e-6)
    expected = range_sigma(replace(NoiseConfig(), model="quadratic"), image.depth[known], None)
    np.testing.assert_allclose(image.sigma[known], expected, rtol=1e-6)
    assert np.isnan(image.sigma[~known]).all()
    counts = processor.counters.counts
    assert counts["no_reading"] == 400
    assert counts["valid"] == counts["output_pixels"] == known.sum() == raw.size - 400 - counts.get("flying", 0)
    assert processor.share_with_depth == pytest.approx(known.mean())


def test_a_camera_without_distortion_is_not_resampled() -> None:
    distance, truth = wall(PLAIN)
    image = DepthProcessor(DepthConfig(), PLAIN).process(0, distance.astype(np.float32), 600.0 / distance**2)
    assert image.camera == PLAIN
    np.testing.assert_allclose(image.depth, truth, rtol=1e-6)


def test_millimetres_along_z_pass_through_exactly() -> None:
    _, truth = wall(PLAIN)
    millimetres = np.rint(1000.0 * truth).astype(np.uint16)
    millimetres[5, 7], millimetres[50, 60] = 0, 65535
    image = DepthProcessor(DEPTH_CAMERA, PLAIN).process(0, millimetres)
    expected = millimetres.astype(np.float64) / 1000.0
    expected[[5, 50], [7, 60]] = np.nan
    np.testing.assert_allclose(image.depth, expected, rtol=3e-7)
    assert np.isnan(image.sigma[5, 7])
    assert np.isnan(image.sigma[50, 60])


def test_range_and_depth_of_one_scene_agree() -> None:
    distance, truth = wall(LENS)
    by_range = DepthProcessor(DepthConfig(), LENS).process(0, distance.astype(np.float32))
    by_depth = DepthProcessor(DEPTH_CAMERA, LENS).process(0, truth.astype(np.float32))
    np.testing.assert_allclose(by_range.depth, by_depth.depth, atol=1e-5)


def test_output_follows_a_given_projection() -> None:
    rectified = Camera(160, 120, 200.0, 200.0, 70.0, 60.0)
    distance, _ = wall(PLAIN)
    image = DepthProcessor(DepthConfig(), PLAIN, rectified).process(0, distance.astype(np.float32))
    _, expected = wall(rectified)
    assert image.camera == rectified
    np.testing.assert_allclose(image.depth[:-1, :-1], expected[:-1, :-1], atol=1e-4)


def test_depth_edges_leave_no_pixel_between_the_surfaces() -> None:
    distance = np.where(np.arange(204) < 100, 1.2, 2.4) * np.ones((204, 1))
    distance[:, 100] = 1.7
    image = DepthProcessor(DepthConfig(), LENS).process(0, distance.astype(np.float32), 500.0 / distance**2)
    length = np.nan_to_num(np.linalg.norm(image.points(), axis=2), nan=1.2)
    assert np.minimum(np.abs(length - 1.2), np.abs(length - 2.4)).max() < 0.005


def test_counters_name_every_reason() -> None:
    processor = DepthProcessor(DepthConfig(), PLAIN)
    distance, _ = wall(PLAIN)
    amplitude = 600.0 / distance**2
    distance[0, 0], amplitude[10, 10], amplitude[20, 20] = np.nan, 1.0, 3000.0
    processor.process(0, distance.astype(np.float32), amplitude)
    processor.process(1, distance.astype(np.float32), amplitude)
    counts = processor.counters.counts
    assert (counts["images"], counts["no_reading"], counts["too_dark"], counts["saturated"]) == (2, 2, 2, 2)
    assert counts["valid"] == counts["output_pixels"] == 2 * (160 * 120 - 3)


@pytest.mark.parametrize("value", [0, 65535])
def test_an_image_without_any_reading_is_all_nan(value: int) -> None:
    for camera in (PLAIN, LENS):
        image = DepthProcessor(DepthConfig(), camera).process(
            0, np.full((camera.height, camera.width), value, dtype=np.uint16), np.zeros((camera.height, camera.width))
        )
        assert np.isnan(image.depth).all()
        assert np.isnan(image.sigma).all()


def test_wrong_shapes_and_types_are_refused() -> None:
    processor = DepthProcessor(DepthConfig(), PLAIN)
    good = np.ones((120, 160), dtype=np.float32)
    with pytest.raises(ValueError, match=r"image must have shape \(120, 160\).*got \(160, 120\)"):
        processor.process(0, good.T)
    with pytest.raises(ValueError, match="amplitude must have shape"):
        processor.process(0, good, good[:60])
    with pytest.raises(ValueError, match="uint8"):
        processor.process(0, good.astype(np.uint8))


def test_intensity_is_normalised(rng: np.random.Generator) -> None:
    intensity = rng.uniform(40.0, 900.0, (120, 160)).astype(np.float32)
    intensity[3, 4] = np.nan
    scaled = normalise(intensity)
    assert scaled is not None
    low, high = np.nanmin(intensity), np.nanmax(intensity)
    np.testing.assert_allclose(scaled[5:], (intensity[5:] - low) / (high - low), rtol=1e-6)
    assert (scaled.min(), scaled.max(), scaled[3, 4]) == (0.0, 1.0, 0.0)
    for empty in (np.full((4, 4), 7.0, np.float32), np.full((4, 4), np.nan, np.float32)):
        np.testing.assert_array_equal(normalise(empty), np.zeros((4, 4), np.float32))
    assert normalise(None) is None


def test_noise_models() -> None:
    distance = np.array([1.0, 2.0, 4.0], dtype=np.float32)
    tof, kinect = replace(NoiseConfig(), floor=0.0), replace(NoiseConfig(), model="quadratic")
    np.testing.assert_allclose(range_sigma(tof, distance, None), [0.00075, 0.003, 0.012], rtol=1e-6)
    amplitude = np.array([250.0, 125.0, 25.0], dtype=np.float32)
    np.testing.assert_allclose(range_sigma(tof, distance, amplitude), [0.0015, 0.003, 0.015], rtol=1e-6)
    np.testing.assert_allclose(range_sigma(kinect, distance, None), 0.0012 + 0.001425 * distance**2, rtol=1e-6)


def test_cloud_is_organised_with_sigma() -> None:
    distance, _ = wall(PLAIN)
    distance[4, 5] = np.nan
    image = DepthProcessor(DepthConfig(), PLAIN).process(0, distance.astype(np.float32))
    cloud = depth_cloud(image)
    assert cloud.shape == (120, 160)
    np.testing.assert_array_equal(np.stack([cloud[k] for k in "xyz"], axis=-1), image.points())
    np.testing.assert_array_equal(cloud["sigma"], image.sigma)
    assert np.isnan(cloud[4, 5]["x"])


@pytest.mark.parametrize("measurement", ["range", "depth"])
def test_the_order_of_a_picture_in_memory_does_not_matter(measurement):
    rng = np.random.default_rng(0)
    image = rng.uniform(1.0, 3.0, (PLAIN.height, PLAIN.width)).astype(np.float32)
    amplitude = 100.0 * image
    processor = DepthProcessor(replace(DepthConfig(), measurement=measurement), PLAIN)
    expected, found = (
        processor.process(0, a, b) for a, b in ((image, amplitude), map(np.asfortranarray, (image, amplitude)))
    )
    np.testing.assert_array_equal(found.depth, expected.depth)
    np.testing.assert_array_equal(found.sigma, expected.sigma)
