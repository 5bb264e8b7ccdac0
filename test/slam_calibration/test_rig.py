# SPDX-License-Identifier: Apache-2.0
"""Calibration of simulated rigs against the truth, on public pictures against published values, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from slam_calibration.board import AprilGrid, Chessboard
from slam_calibration.bundle import BundleConfig, BundleResult, LensState
from slam_calibration.detection import NOTHING, Corners, find_corners, load_grey
from slam_calibration.lens import DISTORTION_PARAMETERS
from slam_calibration.rig import CalibrationConfig, calibrate
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform
from slam_simulation.calibration.board_views import beside, example_camera, random_view, simulate_views

BOARD = Chessboard(9, 7, 0.04).points


def normalised_errors(result: BundleResult, truth: list[LensState]) -> FloatArray:
    """(estimate - truth) / own standard deviation of every rig parameter."""
    errors = [s.parameters - t.parameters for s, t in zip(result.rig.cameras, truth, strict=True)]
    errors += [boxminus(s.T, t.T) for s, t in zip(result.rig.cameras[1:], truth[1:], strict=True)]
    return np.asarray(np.concatenate(errors) / np.sqrt(np.diag(result.covariance)))


def run(rng: np.random.Generator, truth: list[LensState], views: int = 14, noise_px: float = 0.15) -> BundleResult:
    seen = simulate_views(rng, BOARD, truth, [random_view(rng) for _ in range(views)], noise_px)
    sizes = [(state.width, state.height) for state in truth]
    return calibrate(BOARD, seen, sizes, [state.lens for state in truth])


@pytest.mark.parametrize("lens", DISTORTION_PARAMETERS)
def test_exact_corners_give_the_exact_camera(lens: str, rng: np.random.Generator) -> None:
    truth, views = example_camera(lens), [random_view(rng) for _ in range(12)]
    seen = simulate_views(rng, BOARD, [truth], views, 0.0)
    without_prior = CalibrationConfig(bundle=BundleConfig(distortion_prior=1e4))
    result = calibrate(BOARD, seen, [(truth.width, truth.height)], [lens], without_prior)
    assert result.converged
    assert result.rms < 1e-6
    assert np.abs(result.rig.cameras[0].parameters[:4] - truth.parameters[:4]).max() < 1e-3


def test_known_rigs_are_recovered_within_three_standard_deviations(rng: np.random.Generator) -> None:
    rigs = [
        [example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0.005)))],
        [example_camera("none"), example_camera("plumb_bob4", beside(0.0, 0.06, (-0.01, 0.01, 0.01)))],
        [example_camera("equidistant"), example_camera("equidistant", beside(0.06, 0.0, (0.0, 0.03, 0.0)))],
    ]
    errors = np.concatenate([normalised_errors(run(rng, rig), rig) for rig in rigs for _ in range(2)])
    assert len(errors) > 120
    assert np.mean(np.abs(errors) < 3.0) > 0.98
    assert 0.85 < np.std(errors) < 1.15


def test_wrong_corners_do_not_bend_the_calibration(rng: np.random.Generator) -> None:
    truth = [example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0.005)))]
    seen = simulate_views(rng, BOARD, truth, [random_view(rng) for _ in range(12)], 0.15)
    for view in seen[::2]:
        view[0].pixels[::9] += rng.uniform(3.0, 9.0, (len(view[0].pixels[::9]), 2))
    result = calibrate(BOARD, seen, [(640, 480)] * 2, ["plumb_bob"] * 2)
    assert result.rms < 0.25
    assert np.mean(np.abs(normalised_errors(result, truth)) < 3.5) == 1.0


def test_a_view_that_only_one_camera_saw_still_helps(rng: np.random.Generator) -> None:
    truth = [example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.0, 0.0, 0.0)))]
    seen = simulate_views(rng, BOARD, truth, [random_view(rng) for _ in range(12)], 0.1)
    half = [[left, NOTHING] if i % 3 else [left, right] for i, (left, right) in enumerate(seen)]
    few, all_views = ([v for i, v in enumerate(half) if i % 3 == 0], half)
    sizes, lenses = [(640, 480)] * 2, ["plumb_bob"] * 2
    deviations = [calibrate(BOARD, views, sizes, lenses).standard_deviation("0.fx") for views in (few, all_views)]
    assert deviations[1] < 0.8 * deviations[0]


def facing(distance: float) -> FloatArray:
    return make_transform(np.eye(3), np.array([0.02, -0.01, distance]))


def test_parallel_boards_leave_the_focal_length_unobservable(rng: np.random.Generator) -> None:
    seen = simulate_views(rng, BOARD, [example_camera("none")], [facing(0.5 + 0.03 * i) for i in range(10)], 0.2)
    with pytest.raises(ValueError, match=r"do not determine fx of camera 1.*tilt the board"):
        calibrate(BOARD, seen, [(640, 480)], ["none"])


def test_too_few_views_are_counted(rng: np.random.Generator) -> None:
    seen = simulate_views(rng, BOARD, [example_camera("none")], [random_view(rng) for _ in range(3)], 0.2)
    with pytest.raises(ValueError, match="camera 1 shows the board in 3 pictures, at least 4"):
        calibrate(BOARD, [*seen, [NOTHING]], [(640, 480)], ["none"])


def test_corners_on_one_line_are_no_view(rng: np.random.Generator) -> None:
    seen = simulate_views(rng, BOARD, [example_camera("none")], [random_view(rng) for _ in range(8)], 0.1)
    line = Corners(seen[0][0].ids[:9], seen[0][0].pixels[:9])
    result = calibrate(BOARD, [[line], *seen[1:]], [(640, 480)], ["none"])
    assert len(result.views[0][0]) == 0
    assert result.rms < 0.2


def test_cameras_that_never_see_the_board_together(rng: np.random.Generator) -> None:
    truth = [example_camera("none"), example_camera("none")]
    seen = simulate_views(rng, BOARD, truth, [random_view(rng) for _ in range(12)], 0.2)
    apart = [[left, NOTHING] if i < 6 else [NOTHING, right] for i, (left, right) in enumerate(seen)]
    with pytest.raises(ValueError, match="no picture pair"):
        calibrate(BOARD, apart, [(640, 480)] * 2, ["none"] * 2)


def test_unknown_lens_is_named() -> None:
    with pytest.raises(ValueError, match="plumb_bob4"):
        calibrate(BOARD, [], [(640, 480)], ["kannala"])


@pytest.mark.data
def test_published_chessboard_pair(data_dir: Path) -> None:
    """OpenCV's sample pictures: f 535.9 px and 0.39 px rms are published, with a refinement window of 11 px.

    That window reaches over neighbouring corners in the most tilted picture; ours does not and ends lower.
    """
    folder, board = data_dir / "calib_opencv_left_right", Chessboard(9, 6, 0.025)
    numbers = [n for n in range(1, 15) if n != 10]
    views = [
        [find_corners(board, load_grey(folder / f"{side}{n:02d}.jpg")) for side in ("left", "right")] for n in numbers
    ]
    result = calibrate(board.points, views, [(640, 480)] * 2, ["plumb_bob"] * 2)
    assert result.rms < 0.25
    left = result.rig.cameras[0].camera
    assert left.fx == pytest.approx(535.916, rel=0.005)
    assert (left.cx, left.cy) == pytest.approx((342.28, 235.57), abs=2.0)
    assert np.linalg.norm(result.rig.cameras[1].T[:3, 3]) == pytest.approx(3.3269 * 0.025, rel=0.01)


@pytest.mark.data
@pytest.mark.slow
def test_euroc_aprilgrid_against_the_official_calibration(data_dir: Path) -> None:
    folder, board = data_dir / "euroc_v101_visnav100" / "euroc_calib", AprilGrid(6, 6, 0.088, 0.3)
    views = [[find_corners(board, load_grey(folder / f"{i}_{c}.jpg")) for c in (0, 1)] for i in range(52)]
    result = calibrate(board.points, views, [(752, 480)] * 2, ["plumb_bob"] * 2)
    official = [euroc_sensor(data_dir, c) for c in (0, 1)]
    for state, (intrinsics, _) in zip(result.rig.cameras, official, strict=True):
        assert state.parameters[:2] == pytest.approx(intrinsics[:2], rel=0.005)
    T_right_left = invert_transform(official[1][1]) @ official[0][1]
    baseline = np.linalg.norm(result.rig.cameras[1].T[:3, 3])
    assert baseline == pytest.approx(np.linalg.norm(T_right_left[:3, 3]), rel=0.005)
    assert result.rms < 0.25


def euroc_sensor(data_dir: Path, camera: int) -> tuple[list[float], FloatArray]:
    text = (data_dir / f"euroc_v101_micro95/MicroEurocDataset/mav0/cam{camera}/sensor.yaml").read_text()
    document = yaml.safe_load(text.replace("%YAML:1.0", ""))
    return document["intrinsics"], np.array(document["T_BS"]["data"]).reshape(4, 4)
