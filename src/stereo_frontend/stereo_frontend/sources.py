# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs from a side-by-side camera, a video file or a folder of images, without ROS.

A side-by-side UVC camera delivers both images in one frame, left half and right half; so does its recorded video. A
folder holds the images of the left and right camera in two subfolders, or in one with a suffix each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from slam_core.nodes.frame_sources import FrameCapture, images_in, stamp_of_image
from slam_core.types import AnyArray, ByteArray, MakeColour, no_colour

_SUBFOLDERS = (
    ("left", "right"),
    ("image_l", "image_r"),
    ("image_0", "image_1"),
    ("cam0/data", "cam1/data"),
    ("0", "1"),
)
_NAME_ENDS = (("_left", "_right"), ("_l", "_r"), ("_0", "_1"), ("left", "right"))


@dataclass(frozen=True, eq=False)
class RawPair:
    """One unrectified pair: left and right uint8 (height, width), the left one in ``frame_id``.

    ``colour`` makes the left image in colour.
    """

    stamp_ns: int
    left: ByteArray
    right: ByteArray
    frame_id: str = "stereo_left_optical_frame"
    colour: MakeColour = no_colour

    def picture(self) -> ByteArray:
        """The left image in colour, or grey of a grey camera."""
        colour = self.colour()
        return self.left if colour is None else colour


class SideBySideSource:
    """Frames of a side-by-side stereo camera or of a video of one; iterate over it.

    Parameters
    ----------
    device
        Number of the camera ("0" is /dev/video0), its path, or a video file.
    clock
        Gives the stamp (ns) when a frame has been read from a camera. A file is stamped by its own frame times from
        zero on.
    size
        Width and height (px) asked of a camera for the whole frame; None leaves them.

    Raises
    ------
    OSError
        If the device or file cannot be opened.
    """

    def __init__(
        self, device: str, clock: Callable[[], int] | None = None, size: tuple[int, int] | None = None
    ) -> None:
        self._capture = FrameCapture(device, clock)
        if size is not None:
            self._capture.ask_for(*size)
        self.rate = self._capture.rate

    def __iter__(self) -> Iterator[RawPair]:
        while (pair := self.read()) is not None:
            yield pair

    def read(self) -> RawPair | None:
        """The next pair, or None at the end of a file or when the camera has gone."""
        frame = self._capture.read()
        return None if frame is None else split_side_by_side(*frame)

    def close(self) -> None:
        """Let go of the camera."""
        self._capture.close()


class FolderSource:
    """Pairs of images in a folder, in the order of their names; iterate over it.

    Stamps are the numbers in the names where those are nanoseconds (15 digits or more), else the count over ``rate``.

    Raises
    ------
    ValueError
        If the folder holds no pair.
    """

    def __init__(self, folder: Path, rate: float = 10.0) -> None:
        self.rate = rate
        self.pairs = find_pairs(folder)
        self._next = 0

    def __iter__(self) -> Iterator[RawPair]:
        while (pair := self.read()) is not None:
            yield pair

    def read(self) -> RawPair | None:
        """The next pair, or None after the last."""
        if self._next == len(self.pairs):
            return None
        left, right = self.pairs[self._next]
        stamp = stamp_of_image(left, self._next, self.rate)
        self._next += 1
        return RawPair(stamp, read_grey(left), read_grey(right), colour=partial(_read_colour, left))

    def close(self) -> None:
        """Nothing to let go of."""


def split_side_by_side(stamp_ns: int, frame: AnyArray) -> RawPair:
    """Left and right half of a frame, grey or BGR.

    Raises
    ------
    ValueError
        If the width is odd.
    """
    if frame.shape[1] % 2:
        raise ValueError(f"a side-by-side frame must have an even width, got {frame.shape[1]} px")
    grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    half = grey.shape[1] // 2
    colour = no_colour if frame.ndim == 2 else partial(_red_first, frame[:, :half])
    return RawPair(stamp_ns, np.ascontiguousarray(grey[:, :half]), np.ascontiguousarray(grey[:, half:]), colour=colour)


def find_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """Left and right image files of a folder, sorted.

    Raises
    ------
    ValueError
        If there are none, with what was looked for.
    """
    for left_name, right_name in _SUBFOLDERS:
        right_folder = folder / right_name
        pairs = [(p, right_folder / p.name) for p in images_in(folder / left_name) if (right_folder / p.name).is_file()]
        if pairs:
            return pairs
    for left_end, right_end in _NAME_ENDS:
        lefts = [p for p in images_in(folder) if p.stem.endswith(left_end)]
        named = [(p, p.with_name(p.stem[: -len(left_end)] + right_end + p.suffix)) for p in lefts]
        if pairs := [(left, right) for left, right in named if right.is_file()]:
            return pairs
    folders = ", ".join("/".join(names) for names in _SUBFOLDERS)
    raise ValueError(
        f"no stereo images in {folder}: looked for subfolders {folders} and names ending in _left/_right, _0/_1"
    )


def read_grey(path: Path) -> ByteArray:
    """An image file as uint8 grey; OSError if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise OSError(f"cannot read image {path}")
    return np.asarray(image, np.uint8)


def _read_colour(path: Path) -> ByteArray | None:
    """Colours of an image file, red first; None if it is grey."""
    image = cv2.imread(str(path), cv2.IMREAD_ANYCOLOR)
    return None if image is None or image.ndim == 2 else _red_first(image)


def _red_first(image: AnyArray) -> ByteArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
