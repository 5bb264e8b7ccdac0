# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D (Sturm et al. 2012): pictures and depth images of two lists paired in time, and a recording's camera."""

from __future__ import annotations

import bisect
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from slam_bags.datasets.files import START_NS, StampedPair, existing, refuse_rate
from slam_core.storage.files import read_text

LISTS = ("rgb.txt", "depth.txt")
_PAIRING_NS = 20_000_000
_FASTEST_NS = 1_000_000
"""Shortest time between two frames that a camera can mean: 1 kHz."""
_NAME = re.compile(r"freiburg([123])")


@dataclass(frozen=True)
class TumCamera:
    """fx, fy, cx, cy (px) and the distortion k1, k2, p1, p2, k3 of a recording; ``name``: whose they are, in words."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    name: str


_CAMERAS = {
    "1": TumCamera((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), "freiburg1"),
    "2": TumCamera((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), "freiburg2"),
    "3": TumCamera((535.4, 539.2, 320.1, 247.6), (), "freiburg3"),
}
"""The rigs' colour cameras as the data set's page "Intrinsic Camera Calibration of the Kinect" lists them."""
_UNKNOWN = TumCamera((525.0, 525.0, 319.5, 239.5), (), "")
"""The same page's values for anybody who does not calibrate."""


def camera_of(folder: Path) -> TumCamera:
    """The camera that the head of a list (``# file: 'rgbd_dataset_freiburg1_xyz.bag'``) or the folder's name tells."""
    heads = [line for name in LISTS for line in _lines(folder / name) if line.startswith("#")]
    found = [_CAMERAS[match[1]] for text in (*heads, folder.resolve().name) if (match := _NAME.search(text))]
    return found[0] if found else _UNKNOWN


def read_pairs(folder: Path, rate: float | None) -> tuple[list[StampedPair], Counter[str]]:
    """Pictures with their depth images, stamped as the picture, and counts of what is left out.

    What a frame says of the motion is in its pixels; the depth changes little within 20 ms. With ``rate`` (Hz) the
    lines of the lists belong together in their order.

    Raises
    ------
    ValueError
        If the stamps do not ascend as those of a camera do and no rate is given, or do and one is given.
    """
    colour, depth = (_read_list(folder / name) for name in LISTS)
    faults = [fault for name, rows in zip(LISTS, (colour, depth), strict=True) if (fault := _diagnostic(name, rows))]
    if rate is None and faults:
        raise ValueError(f"{folder}: {faults[0]}: give --rate HZ to take the files in the order of the lists")
    if rate is not None:
        if not faults:
            refuse_rate(rate, folder / LISTS[1])
        return _in_order(folder, colour, depth, rate)
    pairs, depths, stamps = [], [stamp for stamp, _ in depth], [stamp for stamp, _ in colour]
    for stamp, picture in colour:
        i = _nearest(depths, stamp)
        if abs(depths[i] - stamp) <= _PAIRING_NS and stamps[_nearest(stamps, depths[i])] == stamp:
            pairs.append(StampedPair(stamp, picture, depth[i][1]))
    if not pairs:
        raise ValueError(f"{folder}: no depth image has a colour image within {_PAIRING_NS / 1e6:.0f} ms")
    left_out = {
        "pictures without depth near in time": len(colour) - len(pairs),
        "depth images without a picture near in time": len(depth) - len(pairs),
    }
    return pairs, Counter(left_out)


_Rows = list[tuple[int, Path]]


def _in_order(folder: Path, colour: _Rows, depth: _Rows, rate: float) -> tuple[list[StampedPair], Counter[str]]:
    if len(colour) != len(depth):
        raise ValueError(f"{folder}: {len(colour)} pictures and {len(depth)} depth images do not pair in their order")
    step = round(1e9 / rate)
    files = zip(colour, depth, strict=True)
    return [StampedPair(START_NS + i * step, c, d) for i, ((_, c), (_, d)) in enumerate(files)], Counter()


def _diagnostic(name: str, rows: _Rows) -> str:
    """Fault of the stamps of a list, in words; "" if nothing is."""
    steps = np.diff([stamp for stamp, _ in rows])
    if (back := np.flatnonzero(steps <= 0)).size:
        return f"the stamps of {name} do not ascend ({rows[back[0] + 1][1].name} after {rows[back[0]][1].name})"
    if steps.size and np.median(steps) < _FASTEST_NS:
        return f"the stamps of {name} are {np.median(steps) / 1e6:g} ms apart, which no camera's are"
    return ""


def _nearest(stamps: Sequence[int], stamp: int) -> int:
    """Index of the one of sorted stamps that is nearest in time."""
    after = bisect.bisect_left(stamps, stamp)
    return min(range(max(after - 1, 0), min(after + 1, len(stamps))), key=lambda i: abs(stamps[i] - stamp))


def _read_list(path: Path) -> _Rows:
    rows: _Rows = []
    for number, line in enumerate(_lines(existing(path, "file list")), 1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        try:
            rows.append((int(Decimal(words[0]) * 10**9), path.parent / words[1]))
        except (InvalidOperation, IndexError, OverflowError, ValueError):
            raise ValueError(f"{path}, line {number}: expected a stamp in seconds and a file, got '{line}'") from None
    if not rows:
        raise ValueError(f"{path} names no files")
    return rows


def _lines(path: Path) -> list[str]:
    return read_text(path, errors="replace").splitlines() if path.exists() else []
