# SPDX-License-Identifier: Apache-2.0
"""Which picture belongs to which view; faults of the files are named."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slam_calibration.board import Chessboard
from slam_calibration.pictures import find_views, pair_pictures


def touch(folder: Path, *names: str) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return [str(folder / name) for name in names]


def names(views: list[list[Path]]) -> list[tuple[str, ...]]:
    return [tuple(path.name for path in view) for view in views]


def test_patterns_pair_by_number_and_leave_out_the_lonely(tmp_path: Path) -> None:
    touch(tmp_path, *(f"left{n:02d}.jpg" for n in (1, 2, 10)), *(f"right{n:02d}.jpg" for n in (2, 3, 10)))
    views = pair_pictures([str(tmp_path / "left*.jpg"), str(tmp_path / "right*.jpg")], 2)
    assert names(views) == [("left02.jpg", "right02.jpg"), ("left10.jpg", "right10.jpg")]


def test_camera_numbers_in_the_names_are_understood(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{n}_{c}.png" for n in (9, 10, 11) for c in (0, 1)), "8_1.png", "12_0.png")
    views = pair_pictures([str(tmp_path / "*_0.png"), str(tmp_path / "*_1.png")], 2)
    assert names(views) == [("9_0.png", "9_1.png"), ("10_0.png", "10_1.png"), ("11_0.png", "11_1.png")]


def test_folders_and_lists_expanded_by_the_shell(tmp_path: Path) -> None:
    left = touch(tmp_path / "cam0", "100.png", "200.png", "300.png")
    right = touch(tmp_path / "cam1", "100.png", "200.png", "300.png", "notes.txt")[:3]
    folders = pair_pictures([str(tmp_path / "cam0"), str(tmp_path / "cam1")], 2)
    assert folders == pair_pictures([*left, *right], 2)
    assert names(folders) == [(n, n) for n in ("100.png", "200.png", "300.png")]
    assert names(pair_pictures([str(tmp_path / "cam0")], 1)) == [("100.png",), ("200.png",), ("300.png",)]


def test_pictures_that_cannot_be_paired(tmp_path: Path) -> None:
    files = touch(tmp_path, "a.png", "b.png", "c.png")
    with pytest.raises(ValueError, match="3 pictures cannot be split"):
        pair_pictures(files, 2)
    with pytest.raises(ValueError, match="no pictures at"):
        pair_pictures([str(tmp_path / "*.jpg")], 1)


def write(path: Path, size: tuple[int, int], board: tuple[int, int] | None = None) -> Path:
    picture = np.full(size[::-1], 200, dtype=np.uint8)
    if board is not None:
        y, x = np.mgrid[: 30 * (board[1] + 1), : 30 * (board[0] + 1)] // 30
        picture[40 : 40 + y.shape[0], 40 : 40 + y.shape[1]] = np.where((x + y) % 2, 230, 20)
    cv2.imwrite(str(path), picture)
    return path


def test_sizes_of_one_camera_must_agree(tmp_path: Path) -> None:
    files = [[write(tmp_path / "1.png", (400, 300), (9, 6))], [write(tmp_path / "2.png", (300, 400))]]
    with pytest.raises(ValueError, match=r"2\.png is 300 x 400 px, the pictures before 400 x 300"):
        find_views(Chessboard(9, 6, 0.025), files)


def test_the_wrong_board_size_is_named(tmp_path: Path) -> None:
    files = [[write(tmp_path / f"{n}.png", (400, 300), (9, 6))] for n in range(3)]
    with pytest.raises(
        ValueError, match=r"no board in any of the 3 pictures of camera 1, but one of 9x6 inner corners"
    ):
        find_views(Chessboard(10, 7, 0.025), files)


def test_no_board_at_all(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no board in any of the 1 pictures of camera 1$"):
        find_views(Chessboard(9, 6, 0.025), [[write(tmp_path / "1.png", (400, 300))]])


def test_progress_counts_pictures(tmp_path: Path) -> None:
    calls: list[int] = []
    files = [[write(tmp_path / f"{n}.png", (400, 300), (9, 6))] for n in range(3)]
    views = find_views(Chessboard(9, 6, 0.025), files, lambda: calls.append(1))
    assert (len(calls), views.found(0), views.sizes) == (3, 3, [(400, 300)])
