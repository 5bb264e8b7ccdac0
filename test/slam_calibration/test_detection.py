# SPDX-License-Identifier: Apache-2.0
"""Corners found in rendered boards, against where they were drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_calibration.board import AprilGrid, Board, Charuco, Chessboard, parse_board
from slam_calibration.detection import find_corners, grey8, load_grey
from slam_simulation.calibration.board_pictures import draw_board

SCALE = 2000.0
"""Texture pixels per metre of board."""

Picture = NDArray[np.uint8]


def photograph(board: Board, seed: int, size: tuple[int, int] = (640, 480)) -> tuple[Picture, NDArray[np.float64]]:
    """A tilted, blurred, noisy picture of the board, and its corners there."""
    rng = np.random.default_rng(seed)
    drawn, drawn_corners = draw_board(board, SCALE)
    h, w = drawn.shape
    source = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float32)
    scale = 0.85 * min(size[0] / w, size[1] / h)
    target = (source - [w / 2, h / 2]) * scale * rng.uniform(0.85, 1.0, (4, 1)) + np.array(size) / 2
    H = cv2.getPerspectiveTransform(source, target.astype(np.float32))
    drawn = cv2.GaussianBlur(drawn, (0, 0), 0.5 / scale)
    picture = cv2.warpPerspective(drawn, H, size, flags=cv2.INTER_AREA, borderValue=255)
    picture = 30.0 + 0.7 * picture.astype(np.float64) + 2.0 * rng.normal(size=picture.shape)
    corners = cv2.perspectiveTransform(drawn_corners[:, None], H)[:, 0]
    return np.clip(picture, 0, 255).astype(np.uint8), corners


BOARDS = {
    "chessboard": Chessboard(9, 6, 0.03),
    "aprilgrid": AprilGrid(5, 4, 0.06, 0.3),
    "charuco": Charuco(8, 6, 0.04, 0.03),
}


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_found_to_a_tenth_of_a_pixel(name: str, seed: int) -> None:
    board = BOARDS[name]
    picture, truth = photograph(board, seed)
    found = find_corners(board, picture)
    assert len(found) > 0.9 * len(board.points)
    assert len(set(found.ids.tolist())) == len(found)
    error = np.linalg.norm(found.pixels - truth[found.ids], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.4


@pytest.mark.skipif(not hasattr(cv2.aruco, "CharucoDetector"), reason="OpenCV before 4.7 draws boards another way")
def test_a_charuco_board_as_opencv_prints_it() -> None:
    board = Charuco(8, 6, 0.04, 0.03)
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    drawn = cv2.aruco.CharucoBoard((8, 6), 0.04, 0.03, family).generateImage((640, 480))
    picture = np.pad(drawn, 40, constant_values=255)
    found = find_corners(board, picture)
    assert len(found) == 35
    np.testing.assert_allclose(found.pixels, board.points[:, :2] * 80 / 0.04 + 39.5, atol=0.1)


def test_an_upside_down_chessboard_keeps_its_corner_numbers() -> None:
    board = BOARDS["chessboard"]
    picture, truth = photograph(board, 4)
    found = find_corners(board, np.ascontiguousarray(picture[::-1, ::-1]))
    np.testing.assert_allclose(found.pixels, np.array([639, 479]) - truth, atol=0.4)


def test_corners_found_in_the_other_order_are_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    board = BOARDS["chessboard"]
    picture, truth = photograph(board, 4)
    search = cv2.findChessboardCorners

    def reversed_search(image: Picture, size: tuple[int, int], flags: int) -> tuple[bool, NDArray[np.float32]]:
        found, corners = search(image, size, flags=flags)
        return found, corners[::-1]

    monkeypatch.setattr(cv2, "findChessboardCorners", reversed_search)
    np.testing.assert_allclose(find_corners(board, picture).pixels, truth, atol=0.4)


@pytest.mark.parametrize("name", ["aprilgrid", "charuco"])
def test_hidden_corners_are_not_invented(name: str) -> None:
    board = BOARDS[name]
    picture, truth = photograph(board, 7)
    hidden = np.arange(0, len(truth), 9)
    for u, v in np.rint(truth[hidden]).astype(int):
        picture[v - 7 : v + 8, u - 7 : u + 2] = 10  # a dark edge through where the corner was
    found = find_corners(board, picture)
    assert len(found) > 0.2 * len(truth)
    assert np.linalg.norm(found.pixels - truth[found.ids], axis=1).max() < 0.5


@pytest.mark.parametrize("name", ["aprilgrid", "charuco"])
def test_half_a_board_is_used(name: str) -> None:
    board = BOARDS[name]
    picture, truth = photograph(board, 5)
    picture[:, :330] = 128
    found = find_corners(board, picture)
    assert 0.2 * len(board.points) < len(found) < 0.7 * len(board.points)
    assert np.linalg.norm(found.pixels - truth[found.ids], axis=1).max() < 0.4


@pytest.mark.parametrize("name", BOARDS)
def test_no_board_is_no_corners(name: str, rng: np.random.Generator) -> None:
    board = BOARDS[name]
    for picture in (
        np.zeros((480, 640), np.uint8),
        np.full((480, 640), 255, np.uint8),
        rng.integers(0, 255, (480, 640)).astype(np.uint8),
    ):
        assert len(find_corners(board, picture)) == 0


def test_a_small_amplitude_picture_of_a_tof_camera(tmp_path: Path) -> None:
    board = Chessboard(6, 5, 0.04)
    picture, truth = photograph(board, 6, (204, 204))
    deep = picture.astype(np.uint16) * 9 + 40
    cv2.imwrite(str(tmp_path / "amplitude.png"), deep)
    found = find_corners(board, load_grey(tmp_path / "amplitude.png"))
    assert len(found) == 30
    assert np.sqrt(np.mean(np.sum((found.pixels - truth) ** 2, axis=1))) < 0.12


def test_pictures_of_any_depth_become_grey() -> None:
    values = np.linspace(0.0, 4.0, 100, dtype=np.float32).reshape(10, 10)
    values[0, 0] = np.nan
    assert grey8(values).dtype == np.uint8
    assert np.ptp(grey8(values)) == 255
    assert not grey8(np.zeros((4, 4), np.uint16)).any()


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "left01.jpg").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"left01\.jpg"):
        load_grey(tmp_path / "left01.jpg")


def test_unknown_dictionary_is_named() -> None:
    with pytest.raises(ValueError, match="DICT_9X9"):
        find_corners(replace(BOARDS["charuco"], dictionary="DICT_9X9"), np.zeros((48, 64), np.uint8))


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ("chessboard:9x6:0.025", Chessboard(9, 6, 0.025)),
        ("aprilgrid:6x6:0.088:0.3", AprilGrid(6, 6, 0.088, 0.3)),
        ("charuco:11x8:0.03:0.022", Charuco(11, 8, 0.03, 0.022)),
        ("charuco:11x8:0.03:0.022:dict_5x5_100", Charuco(11, 8, 0.03, 0.022, "DICT_5X5_100")),
    ],
)
def test_boards_are_parsed(text: str, board: Board) -> None:
    assert parse_board(text) == board


@pytest.mark.parametrize(
    "text",
    ["", "chess:9x6:0.025", "chessboard:9x6", "chessboard:9:0.025", "chessboard:9x6:wide", "chessboard:9x2:0.025",
     "chessboard:9x6:-0.025", "chessboard:9x6:25", "aprilgrid:6x6:0.088:30", "charuco:8x6:0.03:0.04"],
)  # fmt: skip
def test_bad_boards_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"board|edge|spacing|marker|aprilgrid"):
        parse_board(text)


def test_aprilgrid_corners_are_kalibrs() -> None:
    points = AprilGrid(6, 6, 0.088, 0.3).points
    pitch = 0.088 * 1.3
    np.testing.assert_allclose(points[4 * 7 + 2], [pitch + 0.088, pitch + 0.088, 0.0])
    np.testing.assert_allclose(points[:4, :2], [[0, 0], [0.088, 0], [0.088, 0.088], [0, 0.088]])
