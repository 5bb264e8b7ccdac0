# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: where their corners lie on the flat board.

A corner has an id; ``points[id]`` is its place on the board (m), z = 0. Written on the command line as

    chessboard:9x6:0.025           inner corners across x down : edge of a square (m)
    aprilgrid:6x6:0.088:0.3        tags across x down : edge of a tag (m) : gap over edge (Kalibr's grid, family 36h11)
    charuco:11x8:0.030:0.022       squares across x down : edge of a square (m) : edge of a marker (m) [: dictionary]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray


@dataclass(frozen=True)
class Chessboard:
    """``columns`` x ``rows`` inner corners, ``square`` m apart; id = row * columns + column."""

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        _check_grid("chessboard", self.columns, self.rows, 3)
        _check_length("square", self.square)

    @property
    def points(self) -> FloatArray:
        """Corners on the board, shape (n, 3), m."""
        return _lattice(self.columns, self.rows) * self.square


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's grid of AprilTags with black squares between them (Olson 2011; Furgale et al. 2013).

    Tag ids grow along a row, then to the next row; id of a corner = 4 * tag id + k, counted round the tag from its
    corner nearest to the origin: (0, 0), (1, 0), (1, 1), (0, 1) times ``tag``. ``spacing``: gap between tags over
    ``tag``.
    """

    columns: int
    rows: int
    tag: float
    spacing: float

    def __post_init__(self) -> None:
        _check_grid("aprilgrid", self.columns, self.rows, 1)
        _check_length("tag", self.tag)
        if not 0.0 < self.spacing < 2.0:
            raise ValueError(f"aprilgrid spacing is gap over tag edge, got {self.spacing}")

    @property
    def points(self) -> FloatArray:
        """Corners on the board, shape (4 n, 3), m."""
        origins = _lattice(self.columns, self.rows) * (1.0 + self.spacing)
        around = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
        return np.asarray((origins[:, None] + around).reshape(-1, 3) * self.tag)


@dataclass(frozen=True)
class Charuco:
    """A chessboard of ``columns`` x ``rows`` squares with ArUco markers in the white ones (Garrido-Jurado et al. 2014).

    The square at the origin is black; markers are numbered row by row; corners are the inner chessboard corners,
    id = row * (columns - 1) + column.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_250"

    def __post_init__(self) -> None:
        _check_grid("charuco", self.columns, self.rows, 3)
        _check_length("square", self.square)
        if not 0.0 < self.marker < self.square:
            raise ValueError(f"charuco marker must be smaller than its square of {self.square} m, got {self.marker} m")

    @property
    def points(self) -> FloatArray:
        """Inner chessboard corners on the board, shape (n, 3), m."""
        return np.asarray((_lattice(self.columns - 1, self.rows - 1) + np.array([1.0, 1.0, 0.0])) * self.square)

    @property
    def marker_corners(self) -> FloatArray:
        """Corners of each marker by its number, clockwise in print from its top left, shape (m, 4, 3), m."""
        squares = _lattice(self.columns, self.rows)
        white = squares[(squares[:, 0] + squares[:, 1]) % 2 == 1]
        around = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
        return np.asarray((white[:, None] + [0.5, 0.5, 0.0]) * self.square + around * (0.5 * self.marker))


Board = Chessboard | AprilGrid | Charuco


def parse_board(text: str) -> Board:
    """A board from its description, see the top of this file.

    Raises
    ------
    ValueError
        If the description cannot be understood or describes no board.
    """
    kind, *fields = text.lower().split(":")
    arguments = {"chessboard": (2, 2), "aprilgrid": (3, 3), "charuco": (3, 4)}
    if kind not in arguments or not arguments[kind][0] <= len(fields) <= arguments[kind][1]:
        known = "chessboard:9x6:0.025, aprilgrid:6x6:0.088:0.3, charuco:11x8:0.03:0.022[:DICT_4X4_250]"
        raise ValueError(f"board '{text}' is not written like one of {known}")
    try:
        columns, rows = (int(v) for v in fields[0].split("x"))
        first, second = (float(v) for v in (*fields[1:3], "0")[:2])
    except ValueError as error:
        raise ValueError(f"board '{text}': expected COLUMNSxROWS and lengths in m, got '{':'.join(fields)}'") from error
    if kind == "chessboard":
        return Chessboard(columns, rows, first)
    if kind == "aprilgrid":
        return AprilGrid(columns, rows, first, second)
    return Charuco(columns, rows, first, second, *(name.upper() for name in fields[3:]))


def _lattice(columns: int, rows: int) -> FloatArray:
    """Integer points (columns * rows, 3), x fastest, z = 0."""
    y, x = np.mgrid[:rows, :columns]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)


def _check_grid(kind: str, columns: int, rows: int, minimum: int) -> None:
    if columns < minimum or rows < minimum:
        raise ValueError(f"{kind} must be at least {minimum} x {minimum}, got {columns} x {rows}")


def _check_length(name: str, value: float) -> None:
    if not 0.0 < value < 10.0:
        raise ValueError(f"edge of a {name} must be within (0, 10) m, got {value} m")
