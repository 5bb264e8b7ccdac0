# SPDX-License-Identifier: Apache-2.0
"""Pictures of boards: to print, and to photograph with simulated cameras."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from slam_calibration.board import AprilGrid, Board, Charuco, Chessboard
from slam_calibration.detection import APRILTAG_DICTIONARY, KALIBR_BORDER_BITS
from slam_core.geometry import FloatArray
from slam_core.types import ByteArray

WHITE = 255


def draw_board(board: Board, pixels_per_metre: float, margin: int = 80) -> tuple[ByteArray, FloatArray]:
    """The board seen straight on, with a white margin (px).

    Returns
    -------
    picture uint8 (height, width), and the pixels of ``board.points`` in it, shape (n, 2).
    """
    if isinstance(board, AprilGrid):
        picture, corners = _draw_aprilgrid(board, pixels_per_metre)
    elif isinstance(board, Charuco):
        picture, corners = _draw_charuco(board, pixels_per_metre)
    else:
        picture, corners = _draw_chessboard(board, pixels_per_metre)
    # An edge between squares lies between two pixels: half a pixel before the centre of the second.
    return np.pad(picture, margin, constant_values=WHITE), corners + margin - 0.5


def _draw_chessboard(board: Chessboard, scale: float) -> tuple[ByteArray, FloatArray]:
    side = round(board.square * scale)
    corners = np.rint(board.points[:, :2] / board.square) + 1.0
    return _squares(board.columns + 1, board.rows + 1, side), corners * side


def _draw_charuco(board: Charuco, scale: float) -> tuple[ByteArray, FloatArray]:
    side, marker = round(board.square * scale), round(board.marker * scale)
    picture = _squares(board.columns, board.rows, side)
    for number, corners in enumerate(board.marker_corners):
        x, y = np.rint(corners[0, :2] / board.square * side).astype(int)
        picture[y : y + marker, x : x + marker] = _marker(board.dictionary, number, marker, 1)
    return picture, np.rint(board.points[:, :2] / board.square) * side


def _draw_aprilgrid(board: AprilGrid, scale: float) -> tuple[ByteArray, FloatArray]:
    """As Kalibr prints it: rows run upwards from the bottom, with a black square wherever the gaps cross."""
    tag, gap = round(board.tag * scale), round(board.tag * board.spacing * scale)
    pitch = tag + gap
    height, width = board.rows * pitch + gap, board.columns * pitch + gap
    v, u = np.mgrid[:height, :width]
    picture = np.where((v % pitch < gap) & (u % pitch < gap), 0, WHITE).astype(np.uint8)
    corners = np.empty((board.rows * board.columns, 4, 2))
    for number in range(len(corners)):
        row, column = divmod(number, board.columns)
        left, top = column * pitch + gap, height - (row + 1) * pitch
        # Kalibr's codes are half a turn from OpenCV's.
        code = _marker(APRILTAG_DICTIONARY, number, tag, KALIBR_BORDER_BITS)[::-1, ::-1]
        picture[top : top + tag, left : left + tag] = code
        corners[number] = [[left, top + tag], [left + tag, top + tag], [left + tag, top], [left, top]]
    return picture, corners.reshape(-1, 2)


def _squares(columns: int, rows: int, side: int) -> ByteArray:
    y, x = np.mgrid[: rows * side, : columns * side] // side
    return np.where((x + y) % 2 == 0, 0, WHITE).astype(np.uint8)


def _marker(dictionary: str, number: int, side: int, border_bits: int) -> ByteArray:
    aruco: Any = cv2.aruco
    family = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
    draw = getattr(aruco, "generateImageMarker", None) or aruco.drawMarker  # renamed in OpenCV 4.7
    return np.asarray(draw(family, number, side, borderBits=border_bits), dtype=np.uint8)
