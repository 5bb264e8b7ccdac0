# SPDX-License-Identifier: Apache-2.0
"""The circle closes: depth, poses, disparities and ranges of the simulation agree with each other and with the
images.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import ByteArray
from slam_simulation import Scenario, SimulatedFrame, Simulator
from slam_simulation.rendering.raycaster import make_view, trace
from slam_simulation.world.surface_table import Look, compile_world


@pytest.fixture(scope="module")
def frames(simulator: Simulator) -> list[SimulatedFrame]:
    return list(simulator.run(11))


def rectified(simulator: Simulator, side: int, image: ByteArray) -> ByteArray:
    """Undistorted by OpenCV, from the camera info alone."""
    info = simulator.stereo.infos[side]
    size = (info.camera.width, info.camera.height)
    maps = cv2.initUndistortRectifyMap(
        info.camera.K, np.array(info.camera.distortion), info.R, info.P[:, :3], size, cv2.CV_32FC1
    )
    return np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR))


def inner_grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.meshgrid(np.arange(60, 420, 6), np.arange(90, 550, 6), indexing="ij")
    return u.ravel(), v.ravel()


def test_depth_of_one_frame_reprojects_into_another(simulator: Simulator, frames: list[SimulatedFrame]) -> None:
    a, b = frames[2], frames[5]
    camera, (u, v) = simulator.stereo.stereo.camera, inner_grid()
    assert a.truth is not None
    assert b.truth is not None
    points = camera.unproject(np.column_stack([u, v]).astype(float), a.truth.depth[v, u].astype(float))
    T = invert_transform(b.T_world_rig @ simulator.T_rig_left) @ a.T_world_rig @ simulator.T_rig_left
    moved = transform_points(T, points)
    pixels = camera.project(moved)
    inside = (pixels > 1).all(axis=1) & (pixels[:, 0] < 638) & (pixels[:, 1] < 478) & (moved[:, 2] > 0.1)
    nearest = np.rint(pixels[inside]).astype(int)
    same = b.truth.surface[nearest[:, 1], nearest[:, 0]] == a.truth.surface[v, u][inside]
    assert same.mean() > 0.9
    # The same surface in both: back into the first frame from the second's own depth closes to a fraction of a pixel.
    back = camera.unproject(nearest.astype(float), b.truth.depth[nearest[:, 1], nearest[:, 0]].astype(float))
    again = camera.project(transform_points(invert_transform(T), back))
    start = np.column_stack([u, v])[inside] + (nearest - pixels[inside])
    error = np.linalg.norm(again - start, axis=1)[same]
    assert np.median(error) < 0.1
    assert np.percentile(error, 95) < 0.5


def test_rectified_pair_has_the_disparity_of_the_true_depth(simulator: Simulator, frames: list[SimulatedFrame]) -> None:
    residual, vertical = (
        np.concatenate(r) for r in zip(*(_stereo_residual(simulator, f) for f in frames[::3]), strict=True)
    )
    assert len(residual) > 120
    assert abs(np.median(residual)) < 0.03
    assert np.median(np.abs(residual)) < 0.2
    assert abs(np.median(vertical)) < 0.03
    assert np.median(np.abs(vertical)) < 0.2


def _stereo_residual(simulator: Simulator, frame: SimulatedFrame) -> tuple[FloatArray, FloatArray]:
    """Of corners tracked from left to right: disparity minus the true one, and the vertical difference, px."""
    assert frame.left is not None
    assert frame.right is not None
    assert frame.truth is not None
    left, right = rectified(simulator, 0, frame.left), rectified(simulator, 1, frame.right)
    mask = np.pad(np.ones((360, 460), np.uint8), ((60, 60), (90, 90)))
    corners = cv2.goodFeaturesToTrack(left, 400, 0.04, 8, mask=mask)
    start, stereo = corners[:, 0], simulator.stereo.stereo
    depth = cv2.remap(frame.truth.depth, start[:, None, 0], start[:, None, 1], cv2.INTER_LINEAR)
    disparity = np.dstack([stereo.camera.fx * stereo.baseline / depth, np.zeros_like(depth)])
    guess = (corners - disparity).astype(np.float32)
    flow = {"winSize": (15, 15), "maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    tracked, ok, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, guess, **flow)
    # Where the whole window lies on one dull surface: an edge has two disparities, and a highlight its own.
    surface, dull = frame.truth.surface, simulator.world.look[:, Look.GLOSS] == 0.0
    windows = (surface[v - 8 : v + 9, u - 8 : u + 9] for u, v in np.rint(start).astype(int))
    use = (ok[:, 0] > 0) & np.array([bool((w == w[8, 8]).all() and dull[w[8, 8]]) for w in windows])
    residual = (corners - tracked - disparity)[use, 0]
    return residual[:, 0], residual[:, 1]


def test_tof_points_lie_on_the_surfaces_within_their_sigma(simulator: Simulator) -> None:
    tof, rng = simulator.tof, np.random.default_rng(5)
    normalised = []
    for t in (0.0, 1.0):
        T = simulator.path.pose(t)
        view = make_view(simulator.world, T @ tof.T_rig_tof, tof.rays.bounds)
        hits = trace(view, tof.rays)
        length = np.sqrt(1.0 + (tof.rays.rays[..., :2] ** 2).sum(axis=-1))
        inner = np.ones(hits.surface.shape, bool)
        for axis in (0, 1):
            for step in (1, -1):
                inner &= np.roll(hits.surface, step, axis) == hits.surface
        inner[[0, -1]] = inner[:, [0, -1]] = False
        images = tof.capture(simulator.world, T, rng, None)
        sigma = np.hypot(tof.range_sigma(images.amplitude), tof.config.offset_noise)
        use = inner & (images.amplitude > 5) & (images.range > 0)
        normalised.append(((images.range - hits.depth * length) / sigma)[use])
    error = np.concatenate(normalised)
    assert len(error) > 50_000
    assert 0.93 < error.std() < 1.07
    assert abs(error.mean()) < 0.05
    assert (np.abs(error) > 4).mean() < 1e-3


def test_loop_ends_where_it_began(scenario: Scenario) -> None:
    path = scenario.path()
    np.testing.assert_allclose(path.pose(path.duration), path.pose(0.0), atol=1e-12)


def test_images_do_not_depend_on_the_number_of_threads(scenario: Scenario) -> None:
    world = compile_world(scenario.world())
    for one, two in zip(
        Simulator(scenario, world=world, threads=1).run(3),
        Simulator(scenario, world=world, threads=2).run(3),
        strict=True,
    ):
        assert np.array_equal(one.left, two.left)
        assert np.array_equal(one.right, two.right)
        assert one.tof is not None
        assert two.tof is not None
        assert np.array_equal(one.tof.range, two.tof.range)
        assert np.array_equal(one.tof.amplitude, two.tof.amplitude)


def test_another_seed_is_another_building(scenario: Scenario) -> None:
    a = compile_world(scenario.world())
    b = compile_world(replace(scenario, seed=scenario.seed + 1).world())
    assert a.textures.texels.shape != b.textures.texels.shape or not np.array_equal(
        a.textures.texels, b.textures.texels
    )
