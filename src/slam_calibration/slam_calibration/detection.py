# SPDX-License-Identifier: Apache-2.0
"""Finding a board's corners in a picture, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slam_calibration.board import AprilGrid, Board, Charuco, Chessboard
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray

APRILTAG_DICTIONARY = "DICT_APRILTAG_36H11"
KALIBR_BORDER_BITS = 2
"""Kalibr prints its tags with a black border two bits wide."""
_TAG_CORNER_ORDER = [1, 0, 3, 2]
"""Kalibr's corners 0, 1, 2, 3 of a tag in OpenCV's order, which starts at another corner of the same code."""


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a board seen in one picture: ``ids`` (n,) into ``board.points`` and ``pixels`` (n, 2)."""

    ids: npt.NDArray[np.int64]
    pixels: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


NOTHING = Corners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


def load_grey(path: str | Path) -> ByteArray:
    """A picture file as 8-bit grey; deeper pictures (ToF amplitude) are stretched between their percentiles 1 and 99.

    Raises
    ------
    ValueError
        If the file is no picture.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"cannot read {path} as a picture")
    if image.ndim == 3:
        image = cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    return grey8(image)


def grey8(image: AnyArray) -> ByteArray:
    """Any single-channel picture as uint8."""
    if image.dtype == np.uint8:
        return image
    values = np.nan_to_num(image.astype(np.float32), posinf=0.0, neginf=0.0)
    low, high = np.percentile(values, [1.0, 99.0])
    return np.asarray(np.clip((values - low) * (255.0 / max(high - low, 1e-9)), 0.0, 255.0), dtype=np.uint8)


def find_corners(board: Board, image: ByteArray) -> Corners:
    """Corners of ``board`` in an 8-bit grey ``image``; empty where the board is not found."""
    if isinstance(board, Chessboard):
        return _find_chessboard(board, image)
    if isinstance(board, AprilGrid):
        return _find_aprilgrid(board, image)
    return _find_charuco(board, image)


def _find_chessboard(board: Chessboard, image: ByteArray) -> Corners:
    size = (board.columns, board.rows)
    # Small pictures (a ToF camera's) are enlarged for the search: its filters are made for larger squares.
    scale = max(1, round(640 / image.shape[1]))
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else image
    found, corners = cv2.findChessboardCorners(
        large, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:
        found, corners = cv2.findChessboardCornersSB(large, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return NOTHING
    pixels = (corners.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
    grid = pixels.reshape(board.rows, board.columns, 2)
    grid = _upright(board, image, grid)
    pixels = _refine(image, grid.reshape(-1, 2), 0.35 * _local_spacing(grid).ravel())
    return Corners(np.arange(len(pixels)), pixels)


def _upright(board: Chessboard, image: ByteArray, grid: FloatArray) -> FloatArray:
    """The corners in the order that makes the first inner square black.

    A board with one even and one odd side looks different upside down; telling the two apart keeps both cameras of a
    pair on the same corner numbers however the board is held. Other boards keep the order found.
    """
    if (board.columns + board.rows) % 2 == 0:
        return grid
    first, last = grid[:2, :2].mean(axis=(0, 1)), grid[-2:, -2:].mean(axis=(0, 1))
    radius = max(1.0, 0.15 * float(np.linalg.norm(grid[0, 1] - grid[0, 0])))
    return grid if _brightness(image, first, radius) <= _brightness(image, last, radius) else grid[::-1, ::-1]


def _brightness(image: ByteArray, centre: FloatArray, radius: float) -> float:
    (u, v), r = np.rint(centre).astype(int), int(np.ceil(radius))
    return float(image[max(v - r, 0) : v + r + 1, max(u - r, 0) : u + r + 1].mean())


def _find_aprilgrid(board: AprilGrid, image: ByteArray) -> Corners:
    tags, quads = _find_markers(image, APRILTAG_DICTIONARY, KALIBR_BORDER_BITS)
    known = tags < board.columns * board.rows
    tags, quads = tags[known], quads[known][:, _TAG_CORNER_ORDER]
    if len(tags) < 4:
        return NOTHING
    # The detector loses tags that touch their neighbours' corner squares: look for every corner where the tags found
    # say it must be.
    rough = _predict(board.points, (4 * tags[:, None] + np.arange(4)).ravel(), quads.reshape(-1, 2), 24)
    around = rough.reshape(-1, 4, 2)
    edge = np.linalg.norm(around - np.roll(around, 1, axis=1), axis=2).min(axis=1)
    return _confirmed(image, rough, np.repeat(edge * board.spacing, 4))


def _find_charuco(board: Charuco, image: ByteArray) -> Corners:
    markers, quads = _find_markers(image, board.dictionary, 1)
    known = markers < len(board.marker_corners)
    markers, quads = markers[known], quads[known]
    if len(markers) < 4:
        return NOTHING
    points = np.concatenate([board.points, board.marker_corners.reshape(-1, 3)])
    seen = len(board.points) + (4 * markers[:, None] + np.arange(4)).ravel()
    rough = _predict(points, seen, quads.reshape(-1, 2), 16)[: len(board.points)]
    spacing = _local_spacing(rough.reshape(board.rows - 1, board.columns - 1, 2)).ravel()
    return _confirmed(image, rough, spacing * (1.0 - board.marker / board.square))


def _confirmed(image: ByteArray, rough: FloatArray, gap: FloatArray) -> Corners:
    """Predicted corners that are there: refined, not moved far, a saddle of brightness.

    ``rough`` (n, 2) by corner id, NaN where unknown; ``gap`` (n,) width of the pattern's bars at each corner, px.
    """
    size = np.array(image.shape[::-1])
    ids = np.flatnonzero(((rough > 6.0) & (rough < size - 7.0)).all(axis=1) & (gap > 3.0))
    if not len(ids):
        return NOTHING
    rough, gap = rough[ids], gap[ids]
    pixels = _refine(image, rough, 0.4 * gap)
    keep = (np.linalg.norm(pixels - rough, axis=1) < 0.6 * gap) & _are_saddles(image, pixels, 0.3 * gap)
    return Corners(ids[keep], pixels[keep])


def _find_markers(image: ByteArray, dictionary: str, border_bits: int) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Ids (n,) and corners (n, 4, 2) of the square markers in a picture."""
    aruco: Any = cv2.aruco
    if not hasattr(aruco, dictionary):
        raise ValueError(f"unknown marker dictionary '{dictionary}': one of OpenCV's, for instance DICT_4X4_250")
    family = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
    new = hasattr(aruco, "ArucoDetector")  # OpenCV 4.7 made the detector a class
    parameters = aruco.DetectorParameters() if new else aruco.DetectorParameters_create()
    parameters.markerBorderBits = border_bits
    if new:
        quads, ids, _ = aruco.ArucoDetector(family, parameters).detectMarkers(image)
    else:
        quads, ids, _ = aruco.detectMarkers(image, family, parameters=parameters)
    if ids is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
    return ids.ravel().astype(np.int64), np.array(quads, dtype=np.float64).reshape(-1, 4, 2)


def _predict(points: FloatArray, seen: npt.NDArray[np.int64], pixels: FloatArray, neighbours: int) -> FloatArray:
    """Expected pixel of each board point, shape (n, 2); NaN where it cannot be told.

    By the homography of the seen points nearest to it: lens distortion bends the board as a whole, hardly its parts.
    """
    predicted = np.full((len(points), 2), np.nan)
    for identity, point in enumerate(points):
        distance = np.linalg.norm(points[seen, :2] - point[:2], axis=1)
        near = np.argsort(distance, kind="stable")[:neighbours]
        H, _ = cv2.findHomography(points[seen[near], :2], pixels[near])
        if H is not None:
            u, v, w = H @ [point[0], point[1], 1.0]
            predicted[identity] = u / w, v / w
    return predicted


def _local_spacing(grid: FloatArray) -> FloatArray:
    """Distance of each lattice corner to its nearest neighbour, shape (rows, columns), px."""
    nearest = np.full(grid.shape[:2], np.inf)
    down, right = np.linalg.norm(np.diff(grid, axis=0), axis=2), np.linalg.norm(np.diff(grid, axis=1), axis=2)
    nearest[:-1], nearest[1:] = np.fmin(nearest[:-1], down), np.fmin(nearest[1:], down)
    nearest[:, :-1], nearest[:, 1:] = np.fmin(nearest[:, :-1], right), np.fmin(nearest[:, 1:], right)
    return nearest


def _refine(image: ByteArray, pixels: FloatArray, half_window: FloatArray) -> FloatArray:
    """Corners at the saddle of the brightness (Förstner and Gülch 1987, as OpenCV's cornerSubPix).

    Each corner has its own window, half its side in px: a window that reaches the next edge of a foreshortened board
    pulls the corner aside by pixels and the focal length by a percent.
    """
    halves = np.clip(half_window, 2, 11).astype(int)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    refined = np.empty_like(pixels)
    for half in np.unique(halves):
        chosen = halves == half
        start = np.ascontiguousarray(pixels[chosen, None], dtype=np.float32)
        refined[chosen] = cv2.cornerSubPix(image, start, (int(half), int(half)), (-1, -1), criteria)[:, 0]
    return refined


def _are_saddles(image: ByteArray, pixels: FloatArray, radius: FloatArray) -> npt.NDArray[np.bool_]:
    """True if two opposite quarters round each corner are dark and the other two bright, whatever their orientation."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    samples = pixels[:, None] + np.maximum(radius, 1.5)[:, None, None] * ring
    values = cv2.remap(image, samples[..., 0].astype(np.float32), samples[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    values = values.astype(np.float64).reshape(len(pixels), 16)
    spectrum = np.abs(np.fft.rfft(values - values.mean(axis=1, keepdims=True), axis=1)) ** 2
    return np.asarray((spectrum[:, 2] > 0.5 * spectrum[:, 1:].sum(axis=1)) & (np.ptp(values, axis=1) > 20.0))
