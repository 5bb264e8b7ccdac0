# SPDX-License-Identifier: Apache-2.0
"""Frames of a camera, a video file or a folder of images, and the timer that plays them: what all drivers share."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import cv2

from slam_core.types import AnyArray

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")
Reading = TypeVar("Reading")
Read = TypeVar("Read", covariant=True)


class Source(Protocol[Read]):
    """Gives one reading after the other, ``rate`` a second."""

    rate: float

    def read(self) -> Read | None:
        """The next reading, or None at the end."""
        ...

    def close(self) -> None:
        """Let go of what was opened."""
        ...


class FrameCapture:
    """Frames of a camera or a video file.

    Parameters
    ----------
    device
        Number of the camera ("0" is /dev/video0), its path, or a video file.
    clock
        Gives the stamp (ns) when a frame has been read from a camera. A file is stamped by its own frame times from
        zero on.
    raw
        As stored, grey of 16 bits too, instead of in colour.

    Raises
    ------
    OSError
        If the device or file cannot be opened.
    """

    def __init__(self, device: str, clock: Callable[[], int] | None = None, *, raw: bool = False) -> None:
        self._clock = clock
        options = [cv2.CAP_PROP_CONVERT_RGB, 0] if raw else []
        self._capture = cv2.VideoCapture(int(device) if device.isdecimal() else device, cv2.CAP_ANY, options)
        if not self._capture.isOpened():
            raise OSError(f"cannot open camera or video '{device}'")
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0
        self._count = 0

    def ask_for(self, width: int, height: int) -> None:
        """Ask a camera for frames of a size, px; it may give others."""
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0

    def read(self) -> tuple[int, AnyArray] | None:
        """Stamp (ns) and picture of the next frame, or None at the end of a file or when the camera has gone."""
        ok, frame = self._capture.read()
        if not ok:
            return None
        stamp = self._clock() if self._clock is not None else round(self._count / self.rate * 1e9)
        self._count += 1
        return stamp, frame

    def close(self) -> None:
        """Let go of the camera."""
        self._capture.release()


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder by name; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)


def stamp_of_image(path: Path, number: int, rate: float) -> int:
    """Stamp (ns) of an image of a folder: the digits in its name where they are nanoseconds, else its place in time."""
    digits = re.search(r"\d{15,19}", path.stem)
    return int(digits.group()) if digits else round(number / rate * 1e9)


class SourceTimer(Generic[Reading]):
    """Plays a source from a node: ``publish`` is given a reading at a time, ``rate`` a second, until the source ends.

    What cannot be read or ``publish`` refuses (OSError, ValueError) is counted as ``rejected``.
    """

    def __init__(self, node: Any, source: Source[Reading], rate: float, publish: Callable[[Reading], None]) -> None:
        self._node, self._source, self._publish = node, source, publish
        self._timer = node.create_timer(1.0 / rate, self._on_timer)

    def _on_timer(self) -> None:
        try:
            reading = self._source.read()
            if reading is None:
                self._node.get_logger().info(f"the {self._node.config.source} has ended")
                self._timer.cancel()
                return
            self._publish(reading)
        except (ValueError, OSError) as error:
            self._node.health.count("rejected")
            self._node.get_logger().warning(f"images rejected: {error}", throttle_duration_sec=1.0)
