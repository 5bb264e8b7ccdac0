# SPDX-License-Identifier: Apache-2.0
"""Common parts of the data sets' readers: images from files, and a source of readings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from slam_bags.storage.sensor_writer import SensorWriter
from slam_core.types import AnyArray, ByteArray

START_NS = 1_000_000_000
"""Stamp of the first frame where a data set counts from zero: ROS reads the stamp 0 as "no time"."""


class Dataset(Protocol):
    """A data set that can be written to a bag frame by frame.

    ``left_out`` counts, by reason, what of the source does not go into the bag. ``assumed`` names what the source does
    not state, in words.
    """

    left_out: Counter[str]
    assumed: list[str]

    def __len__(self) -> int:
        """Number of frames."""

    def write(self, writer: SensorWriter) -> Iterator[int]:
        """Write everything; yields the number of each frame when it is written."""


@dataclass(frozen=True)
class StampedPair:
    """Files of two images taken together."""

    stamp_ns: int
    first: Path
    second: Path


class Clock:
    """Stamps of frames whose source has none: those of a constant rate.

    Parameters
    ----------
    usual
        Rate of the camera, Hz.
    given
        Rate that the user gives instead, Hz.
    """

    def __init__(self, usual: float, given: float | None) -> None:
        self._rate = usual if given is None else given
        self.assumed = [] if given else [f"{usual:g} frames per second, as the source has no stamps (--rate HZ)"]

    def stamps_ns(self, count: int) -> list[int]:
        """Stamps of so many frames in turn."""
        return [START_NS + i * round(1e9 / self._rate) for i in range(count)]


def refuse_rate(rate: float | None, stamped: Path) -> None:
    """ValueError if a rate is given although the source has stamps."""
    if rate is not None:
        raise ValueError(f"{stamped} has the stamps of the frames: leave --rate out")


def read_grey(path: Path) -> ByteArray:
    """A grey image uint8 (height, width) of a file; ValueError if it is none."""
    return _checked(path, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def read_colour(path: Path) -> ByteArray:
    """A colour image uint8 (height, width, 3), red first, of a file; ValueError if it is none."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: expected a picture, found nothing readable")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path) -> AnyArray:
    """A depth image uint16 (height, width), values as in the file; ValueError if it is none."""
    return _checked(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint16)


def existing(path: Path, what: str) -> Path:
    """``path``, or ValueError saying what was looked for."""
    if not path.exists():
        raise ValueError(f"{what} not found at {path}")
    return path


def _checked(path: Path, image: AnyArray | None, dtype: type) -> AnyArray:
    if image is None or image.ndim != 2 or image.dtype != dtype:
        found = "nothing readable" if image is None else f"{image.dtype} {image.shape}"
        raise ValueError(f"{path}: expected an image of {np.dtype(dtype)} (height, width), found {found}")
    return image
