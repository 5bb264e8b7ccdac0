# SPDX-License-Identifier: Apache-2.0
"""Pictures by camera and view, and the part of the board that each shows."""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slam_calibration.board import Board, Chessboard
from slam_calibration.detection import Corners, find_corners, load_grey

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")


@dataclass(frozen=True, eq=False)
class BoardViews:
    """``corners[v][c]`` seen by camera c in view v, the files they come from, and each camera's (width, height)."""

    corners: list[list[Corners]]
    files: list[list[Path]]
    sizes: list[tuple[int, int]]

    def found(self, camera: int) -> int:
        """Number of pictures of a camera in which the board was found."""
        return sum(len(view[camera]) > 0 for view in self.corners)


def pair_pictures(arguments: Sequence[str], cameras: int) -> list[list[Path]]:
    """The pictures of each view, one per camera.

    Parameters
    ----------
    arguments
        For one camera: files, folders and glob patterns. For two: exactly two folders or patterns, one per camera, or
        all files of the first camera followed by as many of the second.
    cameras
        How many there are.

    Raises
    ------
    ValueError
        If there are no pictures, or the two cameras' pictures cannot be paired.
    """
    if cameras == 1:
        return [[path] for argument in arguments for path in _expand(argument)]
    lists = [_expand(argument) for argument in arguments]
    if len(lists) != cameras or min(len(files) for files in lists) < 2:
        files = [path for paths in lists for path in paths]
        if len(files) % cameras:
            raise ValueError(f"{len(files)} pictures cannot be split between {cameras} cameras")
        n = len(files) // cameras
        lists = [files[c * n : (c + 1) * n] for c in range(cameras)]
    return _paired(lists)


def _expand(argument: str) -> list[Path]:
    path = Path(argument)
    if path.is_dir():
        found = sorted((p for p in path.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
    else:
        found = [path] if path.is_file() else sorted((Path(p) for p in glob.glob(argument)), key=_natural)
    if not found:
        raise ValueError(f"no pictures at {argument}")
    return found


def _natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Sort key that puts frame 10 after frame 9."""
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name))


def _paired(lists: Sequence[list[Path]]) -> list[list[Path]]:
    """Pairs by the numbers in the names (all, all but the last, or all but the first), else by order."""
    for part in (slice(None), slice(None, -1), slice(1, None)):
        keyed = [{tuple(re.findall(r"\d+", p.stem))[part]: p for p in files} for files in lists]
        common = [key for key in keyed[0] if all(key in other for other in keyed[1:])]
        if all(len(k) == len(f) for k, f in zip(keyed, lists, strict=True)) and () not in common and common:
            return [[k[key] for k in keyed] for key in common]
    if len({len(files) for files in lists}) != 1:
        raise ValueError(f"the cameras have {' and '.join(str(len(f)) for f in lists)} pictures that cannot be paired")
    return [list(view) for view in zip(*lists, strict=True)]


def find_views(board: Board, files: list[list[Path]], progress: Callable[[], None] = lambda: None) -> BoardViews:
    """Find the board in every picture; ``progress`` is called after each.

    Raises
    ------
    ValueError
        For a file that is no picture, pictures of one camera that differ in size, or a camera without any board.
    """
    corners: list[list[Corners]] = []
    sizes: dict[int, tuple[int, int]] = {}
    for view in files:
        corners.append([])
        for c, path in enumerate(view):
            image = load_grey(path)
            size = (image.shape[1], image.shape[0])
            if sizes.setdefault(c, size) != size:
                raise ValueError(
                    f"{path} is {size[0]} x {size[1]} px, the pictures before {sizes[c][0]} x {sizes[c][1]}"
                )
            corners[-1].append(find_corners(board, image))
            progress()
    views = BoardViews(corners, files, [sizes[c] for c in range(len(sizes))])
    for c in range(len(sizes)):
        if views.found(c) == 0:
            raise ValueError(f"no board in any of the {len(files)} pictures of camera {c + 1}{_hint(board, files, c)}")
    return views


def _hint(board: Board, files: list[list[Path]], camera: int) -> str:
    """A chessboard of a neighbouring size that is there instead, for the message."""
    if not isinstance(board, Chessboard):
        return ""
    for view in files[:3]:
        image = load_grey(view[camera])
        for dc, dr in ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1)):
            columns, rows = board.columns + dc, board.rows + dr
            if min(columns, rows) >= 3 and len(find_corners(replace(board, columns=columns, rows=rows), image)):
                return (
                    f", but one of {columns}x{rows} inner corners in {view[camera].name}: "
                    f"the size counts inner corners, not squares"
                )
    return ""
