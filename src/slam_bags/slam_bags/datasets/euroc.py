# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV (Burri et al. 2016): stereo and IMU with ground truth of the IMU body.

Two layouts: the ASL folders (``mav0/cam0/data/*.png``, ``data.csv``, ``sensor.yaml``, ``imu0``,
``state_groundtruth_estimate0``; also ``imu0/data.txt`` and ``truth_body_imu.txt``, as excerpts have them, values apart
by blanks) and a flat folder of keyframes ``<ns>_0.jpg``, ``<ns>_1.jpg``, whose calibration is a
folder that holds ``cam0/sensor.yaml`` and ``cam1/sensor.yaml``.

base_link is the rectified left camera turned to X forward, Y left, Z up; ground truth is carried over to it.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from slam_bags.datasets.files import StampedPair, existing, read_grey, refuse_rate
from slam_bags.storage.sensor_writer import IMU_FRAME, LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import FloatArray, invert_transform, make_transform
from slam_core.storage.files import read_text
from slam_core.trajectory import Trajectory, read_trajectory
from slam_core.types import ImuSample

_KEYFRAME = re.compile(r"(\d{16,20})_0\.(jpg|png)$")
_TRUTH_MARGIN_NS = 500_000_000


@dataclass(frozen=True, eq=False)
class _Mount:
    """A camera and its pose T_body_camera."""

    camera: Camera
    T_body_camera: FloatArray


class EurocDataset:
    """Stereo pairs, IMU and ground truth of one EuRoC sequence.

    Parameters
    ----------
    source
        Folder in one of the two layouts.
    calibration
        Folder with ``cam0/sensor.yaml`` and ``cam1/sensor.yaml`` (or with ``mav0`` above them); default: the source.
    ground_truth
        Poses of the IMU body (EuRoC csv or TUM); default: ``state_groundtruth_estimate0`` or ``truth_body_imu.txt`` of
        the source.
    """

    def __init__(
        self, source: Path, calibration: Path | None = None, ground_truth: Path | None = None, rate: float | None = None
    ) -> None:
        root = _root(source)
        refuse_rate(rate, root)
        self.assumed: list[str] = []
        sensors = _root(calibration) if calibration else root
        left, right = (_read_mount(sensors / name / "sensor.yaml") for name in ("cam0", "cam1"))
        self._infos, T_rectified_left = rectify(left, right)
        self._T_body_base = left.T_body_camera @ invert_transform(T_rectified_left) @ invert_transform(T_BASE_OPTICAL)
        self._baseline = self._infos[1].baseline
        self._pairs = _asl_pairs(root) if (root / "cam0").is_dir() else _keyframe_pairs(root)
        if not self._pairs:
            raise ValueError(
                f"{source} holds no stereo pairs, neither mav0/cam0/data.csv nor <ns>_0.jpg and <ns>_1.jpg"
            )
        self.left_out = Counter[str]()
        self._truth = self._read_truth(root, ground_truth)
        self._imu = self._read_imu(root / "imu0")
        if (root / "cam0").is_dir():
            images = _images_by_stamp(root / "cam0").keys() ^ _images_by_stamp(root / "cam1").keys()
            self.left_out["images without a partner of the same stamp"] = len(images)

    def __len__(self) -> int:
        return len(self._pairs)

    def write(self, writer: SensorWriter) -> Iterator[int]:
        """Extrinsics first, then readings in the order of their stamps."""
        writer.extrinsics(self._pairs[0].stamp_ns, self._extrinsics())
        samples = iter(self._imu)
        sample = next(samples, None)
        for number, pair in enumerate(self._pairs):
            while sample is not None and sample.stamp_ns <= pair.stamp_ns:
                writer.imu(sample)
                sample = next(samples, None)
            writer.stereo(pair.stamp_ns, read_grey(pair.first), read_grey(pair.second), self._infos)
            yield number
        for stamp, T_world_body in zip(self._truth.stamps_ns, self._truth.poses, strict=True):
            writer.ground_truth(int(stamp), T_world_body @ self._T_body_base)

    def _extrinsics(self) -> dict[str, FloatArray]:
        T_left_right = make_transform(np.eye(3), np.array([self._baseline, 0.0, 0.0]))
        frames = {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL @ T_left_right}
        return frames | ({IMU_FRAME: invert_transform(self._T_body_base)} if self._imu else {})

    def _read_truth(self, root: Path, path: Path | None) -> Trajectory:
        candidates = [root / "state_groundtruth_estimate0" / "data.csv", root / "truth_body_imu.txt"]
        path = path or next((p for p in candidates if p.exists()), None)
        if path is None:
            return Trajectory.from_estimates([])
        truth = read_trajectory(path)
        first, last = self._pairs[0].stamp_ns - _TRUTH_MARGIN_NS, self._pairs[-1].stamp_ns + _TRUTH_MARGIN_NS
        inside = truth.select((truth.stamps_ns >= first) & (truth.stamps_ns <= last))
        if not len(inside):
            raise ValueError(f"{path} has no pose within the time of the images")
        self.left_out["true poses outside the time of the images"] = len(truth) - len(inside)
        return inside

    def _read_imu(self, folder: Path) -> list[ImuSample]:
        path = next((p for p in (folder / "data.csv", folder / "data.txt") if p.exists()), None)
        if path is None:
            return []
        samples = [_imu_sample(row) for row in _rows(path)]
        first, last = self._pairs[0].stamp_ns - _TRUTH_MARGIN_NS, self._pairs[-1].stamp_ns
        inside = [sample for sample in samples if first <= sample.stamp_ns <= last]
        self.left_out["IMU readings outside the time of the images"] = len(samples) - len(inside)
        return inside


def rectify(left: _Mount, right: _Mount) -> tuple[tuple[CameraInfo, CameraInfo], FloatArray]:
    """Camera infos of a calibrated pair (Bouguet's method, as in OpenCV), and T_rectified_left of the left camera."""
    T_right_left = invert_transform(right.T_body_camera) @ left.T_body_camera
    size = (left.camera.width, left.camera.height)
    distortions = [np.array(m.camera.distortion) for m in (left, right)]
    rectification = cv2.stereoRectify(
        left.camera.K,
        distortions[0],
        right.camera.K,
        distortions[1],
        size,
        T_right_left[:3, :3],
        T_right_left[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    R_left, R_right, P_left, P_right = (np.asarray(m, dtype=np.float64) for m in rectification[:4])
    infos = CameraInfo(left.camera, R_left, P_left), CameraInfo(right.camera, R_right, P_right)
    return infos, make_transform(R_left, np.zeros(3))


def _root(path: Path) -> Path:
    """The folder that holds cam0, wherever above it the user pointed."""
    existing(path, "EuRoC folder")
    for candidate in (path, path / "mav0", *sorted(path.glob("*/mav0"))):
        if (candidate / "cam0").is_dir():
            return candidate
    keyframes = sorted(p.parent for p in path.glob("*/*_0.jpg"))
    return path if any(path.glob("*_0.jpg")) or not keyframes else keyframes[0]


def _read_mount(path: Path) -> _Mount:
    document = _read_sensor_yaml(existing(path, "camera calibration (--calibration)"))
    try:
        width, height = document["resolution"]
        k1, k2, p1, p2 = document["distortion_coefficients"]
        fx, fy, cx, cy = document["intrinsics"]
        camera = Camera(width, height, fx, fy, cx, cy, "plumb_bob", (k1, k2, p1, p2, 0.0))
        return _Mount(camera, np.array(document["T_BS"]["data"], dtype=np.float64).reshape(4, 4))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no EuRoC sensor.yaml of a radial-tangential camera: {error}") from error


def _read_sensor_yaml(path: Path) -> dict[str, Any]:
    document = yaml.safe_load(read_text(path).replace("%YAML:1.0", ""))
    if not isinstance(document, dict):
        raise ValueError(f"{path} is no EuRoC sensor.yaml")
    return document


def _asl_pairs(root: Path) -> list[StampedPair]:
    """Pairs of equal stamp of ``cam0/data.csv`` and ``cam1/data.csv``, or of the images themselves without the csv."""
    left, right = (_images_by_stamp(root / name) for name in ("cam0", "cam1"))
    return [StampedPair(stamp, left[stamp], right[stamp]) for stamp in sorted(left.keys() & right.keys())]


def _images_by_stamp(camera: Path) -> dict[int, Path]:
    table = camera / "data.csv"
    if table.exists():
        return {int(row[0]): camera / "data" / row[1].strip() for row in _rows(table)}
    return {int(path.stem): path for path in (camera / "data").glob("*.png") if path.stem.isdigit()}


def _keyframe_pairs(folder: Path) -> list[StampedPair]:
    pairs = []
    for path in sorted(folder.iterdir()):
        if match := _KEYFRAME.match(path.name):
            other = existing(path.with_name(f"{match[1]}_1.{match[2]}"), "right image")
            pairs.append(StampedPair(int(match[1]), path, other))
    return sorted(pairs, key=lambda pair: pair.stamp_ns)


def _imu_sample(row: list[str]) -> ImuSample:
    values = np.array(row[1:7], dtype=np.float64)
    return ImuSample(int(row[0]), values[:3], values[3:])


def _rows(path: Path) -> Iterator[list[str]]:
    """Cells of a table whose values are apart by commas or, in ``.txt`` files, by blanks."""
    with path.open(encoding="utf-8", newline="") as file:
        lines = (line for line in file if line.strip() and not line.startswith("#"))
        yield from (line.split() for line in lines) if path.suffix == ".txt" else csv.reader(lines)
