# SPDX-License-Identifier: Apache-2.0
"""KITTI odometry (Geiger et al. 2012): rectified stereo pairs, ``calib.txt``, ``times.txt``, poses of the left camera.

Image folders ``image_0``/``image_1`` (grey) or ``image_2``/``image_3`` (colour), also named ``image_l``/``image_r``;
without ``times.txt`` the frames are 0.1 s apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np

from slam_bags.datasets.files import START_NS, Clock, StampedPair, existing, read_grey, refuse_rate
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import FloatArray, invert_transform, make_transform
from slam_core.storage.files import read_text
from slam_core.trajectory import read_trajectory

_FOLDERS = (("image_0", "image_1"), ("image_l", "image_r"), ("image_2", "image_3"))
_RATE = 10.0


class KittiDataset:
    """Stereo pairs and ground truth of one KITTI odometry sequence.

    Parameters
    ----------
    source
        Folder of the sequence.
    calibration
        File with the projection matrices; default: ``calib.txt`` of the source.
    ground_truth
        File with one 3x4 pose of the left camera per frame; default: ``poses.txt`` of the source.
    rate
        Frames per second where the source has no ``times.txt``; default: 10.
    """

    def __init__(
        self, source: Path, calibration: Path | None = None, ground_truth: Path | None = None, rate: float | None = None
    ) -> None:
        self._folders = _image_folders(existing(source, "KITTI sequence"))
        self._pairs, self.assumed = _pairs(source, self._folders, rate)
        self._projections = _read_projections(calibration or source / "calib.txt", self._folders[0].name)
        self._truth = _read_truth(ground_truth or source / "poses.txt", len(self._pairs))
        names = [{path.name for path in folder.glob("*.png")} for folder in self._folders]
        self.left_out = Counter({"right images without a left one": len(names[1] - names[0])})

    def __len__(self) -> int:
        return len(self._pairs)

    def write(self, writer: SensorWriter) -> Iterator[int]:
        """Extrinsics first, then pair and pose of each frame."""
        first = read_grey(self._pairs[0].first)
        infos = _infos(self._projections, first.shape)
        T_left_right = make_transform(np.eye(3), np.array([infos[1].baseline, 0.0, 0.0]))
        writer.extrinsics(
            self._pairs[0].stamp_ns, {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL @ T_left_right}
        )
        for number, pair in enumerate(self._pairs):
            writer.stereo(pair.stamp_ns, read_grey(pair.first), read_grey(pair.second), infos)
            if len(self._truth):
                T_world_base = T_BASE_OPTICAL @ self._truth[number] @ invert_transform(T_BASE_OPTICAL)
                writer.ground_truth(pair.stamp_ns, T_world_base)
            yield number


def _image_folders(source: Path) -> tuple[Path, Path]:
    for left, right in _FOLDERS:
        if (source / left).is_dir() and (source / right).is_dir():
            return source / left, source / right
    names = ", ".join("/".join(pair) for pair in _FOLDERS)
    raise ValueError(f"{source} holds none of the image folders {names}")


def _pairs(source: Path, folders: tuple[Path, Path], rate: float | None) -> tuple[list[StampedPair], list[str]]:
    """The pairs in turn, and what is assumed of their stamps."""
    left = sorted(folders[0].glob("*.png"))
    if not left:
        raise ValueError(f"{folders[0]} holds no png images")
    stamps, assumed = _read_times(source / "times.txt", len(left), rate)
    right = [existing(folders[1] / path.name, "right image") for path in left]
    return [StampedPair(s, a, b) for s, a, b in zip(stamps, left, right, strict=True)], assumed


def _read_times(path: Path, count: int, rate: float | None) -> tuple[list[int], list[str]]:
    if not path.exists():
        clock = Clock(_RATE, rate)
        return clock.stamps_ns(count), clock.assumed
    refuse_rate(rate, path)
    stamps = [START_NS + int(Decimal(line) * 10**9) for line in read_text(path).split()]
    if len(stamps) < count:
        raise ValueError(f"{path} has {len(stamps)} times for {count} images")
    return stamps[:count], []


def _read_projections(path: Path, left_folder: str) -> tuple[FloatArray, FloatArray]:
    """P of the left and right camera: two lines in their order, or the lines ``P0:`` to ``P3:`` of the benchmark."""
    rows = [line.split() for line in read_text(existing(path, "calibration")).splitlines() if line.strip()]
    named = {row[0].rstrip(":"): row[1:] for row in rows if row[0].startswith("P")}
    wanted = ("P2", "P3") if left_folder == "image_2" else ("P0", "P1")
    numbers = [named[name] for name in wanted if name in named] or rows[:2]
    try:
        left, right = (np.array(row, dtype=np.float64).reshape(3, 4) for row in numbers)
    except ValueError as error:
        raise ValueError(f"{path} does not hold two 3x4 projection matrices: {error}") from error
    return left, right


def _infos(projections: tuple[FloatArray, FloatArray], shape: tuple[int, ...]) -> tuple[CameraInfo, CameraInfo]:
    """Camera infos relative to the left camera: colour cameras have an offset to camera 0 in both P."""
    left, right = (P.copy() for P in projections)
    right[0, 3] -= left[0, 3]
    left[:, 3] = 0.0
    right[1:, 3] = 0.0
    height, width = shape[:2]
    cameras = [Camera(width, height, P[0, 0], P[1, 1], P[0, 2], P[1, 2]) for P in (left, right)]
    return CameraInfo(cameras[0], np.eye(3), left), CameraInfo(cameras[1], np.eye(3), right)


def _read_truth(path: Path, count: int) -> FloatArray:
    """T_first_camera of every frame, (n, 4, 4); empty without the file."""
    if not path.exists():
        return np.empty((0, 4, 4))
    truth = read_trajectory(path)
    if len(truth) < count:
        raise ValueError(f"{path} has {len(truth)} poses for {count} images")
    return truth.poses[:count]
