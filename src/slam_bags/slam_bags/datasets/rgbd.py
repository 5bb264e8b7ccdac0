# SPDX-License-Identifier: Apache-2.0
"""RGB-D sequences as a depth camera with a grey and a colour picture: 7-Scenes, TUM RGB-D, and plain folders.

- 7-Scenes (Shotton et al. 2013): ``frame-000000.color.png``, ``.depth.png`` (mm; 0 and 65535 are invalid),
  ``.pose.txt`` (camera to world); 30 Hz; ``camera-intrinsics.txt`` if there is one.
- TUM RGB-D (Sturm et al. 2012): ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``; depth in 1/5000 m; paired by time
  (:mod:`slam_bags.datasets.tum_rgbd`).
- plain: ``color/<n>.png``, ``depth/<n>.png`` (mm), ``K.txt``, ``pose.txt`` with x y z qx qy qz qw per frame; no stamps,
  taken as 30 Hz.
- numbered, as deep-video-mvs (Duzceker et al. 2021) has it: ``images/<n>.png``, ``depth/<n>.png`` (mm, registered),
  ``K.txt``, ``poses.txt`` with a 4x4 camera-to-world matrix per line; no stamps, taken as 10 Hz.

``K.txt`` is the 3x3 camera matrix. A folder without one needs ``calibration``: cameras of one make differ by 2 %.

The depth is along z, so it goes to ``tof/depth/image_raw`` as it is; the picture, registered to it, becomes the
amplitude in grey, which features come from, and ``tof/color/image_raw``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam_bags.datasets.files import Clock, StampedPair, existing, read_colour, read_depth, read_grey
from slam_bags.datasets.picture_registration import ColourCamera, register_pictures
from slam_bags.datasets.tum_rgbd import camera_of, read_pairs
from slam_bags.storage.sensor_writer import LEFT_FRAME, T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_core.camera import Camera, CameraInfo
from slam_core.camera_info import read_camera_info
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, invert_transform, make_transform, transform_from_pose7
from slam_core.messages import rectified_info
from slam_core.storage.files import read_text
from slam_core.trajectory import read_trajectory
from slam_core.types import AnyArray
from tof_driver.depth import MILLIMETRES_INVALID

_RATE = 30.0
_NUMBERED_RATE = 10.0
_KINECT_SEVEN_SCENES = (585.0, 585.0, 320.0, 240.0)
_KINECT_SEVEN_SCENES_COLOUR = ColourCamera((530.0, 530.0, 320.0, 240.0), (0.0256, 0.0, 0.0))
"""7-Scenes does not register its pictures. Focal length and offset put depth edges on picture edges (redkitchen)."""

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, px."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """Files, unit of the depth (units per metre), stated intrinsics, and poses T_world_camera by stamp."""

    pairs: list[StampedPair]
    units_per_metre: float
    intrinsics: Intrinsics | None
    poses: list[tuple[int, FloatArray]]
    colour: ColourCamera | None = None
    """The camera of the pictures where they are not registered to the depth."""
    left_out: Counter[str] = field(default_factory=Counter)
    assumed: list[str] = field(default_factory=list)
    usual: str = ""
    """Intrinsics that are those of the data set, not of this recording, in words."""
    distortion: tuple[float, ...] = ()


class RgbdDataset:
    """Depth and grey images of one RGB-D sequence.

    Parameters
    ----------
    source
        Folder in one of the layouts.
    calibration
        Camera info YAML or a text file with the 3x3 camera matrix; default: what the data set states.
    ground_truth
        TUM file of camera poses; default: those of the source.
    rate
        Frames per second where the source has no stamps; default: that of its layout.
    """

    def __init__(
        self, source: Path, calibration: Path | None = None, ground_truth: Path | None = None, rate: float | None = None
    ) -> None:
        self._layout = _find_layout(existing(source, "RGB-D folder"), rate)
        self.left_out = self._layout.left_out
        self.assumed = list(self._layout.assumed)
        if self._layout.intrinsics is None and calibration is None:
            raise ValueError(
                f"{source} states no camera matrix: give it by --calibration (3x3 text or camera info YAML)"
            )
        if calibration is None and self._layout.usual:
            self.assumed.append(self._layout.usual)
        self._calibration = calibration
        self._poses = _read_tum(ground_truth) if ground_truth else self._layout.poses

    def __len__(self) -> int:
        return len(self._layout.pairs)

    def write(self, writer: SensorWriter) -> Iterator[int]:
        """Extrinsics first (the depth camera is the rig's origin), then images, then ground truth."""
        pairs = self._layout.pairs
        writer.extrinsics(pairs[0].stamp_ns, {LEFT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_OPTICAL})
        info: CameraInfo | None = None
        for number, pair in enumerate(pairs):
            depth = _clean(read_depth(pair.second), self._layout.units_per_metre)
            info = info or self._info(depth.shape)
            grey, colour = read_grey(pair.first), read_colour(pair.first)
            if self._layout.colour is not None:
                metres = depth * (1.0 / self._layout.units_per_metre if depth.dtype == np.uint16 else 1.0)
                grey, colour = register_pictures((grey, colour), metres, info.camera, self._layout.colour)
            writer.depth(pair.stamp_ns, depth, info, measurement="depth", amplitude=grey, color=colour)
            yield number
        for stamp, T_world_camera in self._poses:
            writer.ground_truth(stamp, _level(T_world_camera))

    def _info(self, shape: tuple[int, ...]) -> CameraInfo:
        if self._calibration is not None and self._calibration.suffix in (".yaml", ".yml"):
            return read_camera_info(existing(self._calibration, "calibration")).info
        numbers = self._layout.intrinsics
        if self._calibration is not None:
            numbers = _read_camera_matrix(existing(self._calibration, "calibration"))
        assert numbers is not None, "asked for when the folder was read"
        distortion = self._layout.distortion if self._calibration is None else ()
        if not distortion:
            return rectified_info(Camera(shape[1], shape[0], *numbers))
        camera = Camera(shape[1], shape[0], *numbers, "plumb_bob", distortion)
        return CameraInfo(camera, np.eye(3), np.zeros((3, 4)))


def _level(T_world_camera: FloatArray) -> FloatArray:
    """T_world_base with the world's axes turned as the rig's, so that Z is roughly up where the camera's y was down."""
    turn = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))
    return turn @ T_world_camera @ invert_transform(T_BASE_OPTICAL)


def _clean(depth: AnyArray, units_per_metre: float) -> AnyArray:
    """uint16 mm with 0 for no reading; float32 m where the unit is another."""
    depth = np.where(depth == MILLIMETRES_INVALID, 0, depth).astype(np.uint16)
    return depth if units_per_metre == 1000.0 else depth.astype(np.float32) / np.float32(units_per_metre)


def _find_layout(source: Path, rate: float | None) -> _Layout:
    for candidate in (source, source / "data"):
        if any(candidate.glob("frame-*.depth.png")):
            return _seven_scenes(candidate, Clock(_RATE, rate))
        if (candidate / "depth.txt").exists():
            return _tum(candidate, rate)
        if (candidate / "depth").is_dir() and (candidate / "color").is_dir():
            return _plain(candidate, Clock(_RATE, rate))
        if (candidate / "depth").is_dir() and (candidate / "images").is_dir():
            return _numbered(candidate, Clock(_NUMBERED_RATE, rate))
    raise ValueError(
        f"{source} is no RGB-D folder: no frame-*.depth.png, no depth.txt, no depth/ beside color/ or images/"
    )


def _seven_scenes(folder: Path, clock: Clock) -> _Layout:
    pairs, poses = [], []
    depths = sorted(folder.glob("frame-*.depth.png"))
    for stamp, depth in zip(clock.stamps_ns(len(depths)), depths, strict=True):
        stem = depth.name.removesuffix(".depth.png")
        colour = [p for p in (folder / f"{stem}.color.{kind}" for kind in ("png", "jpg")) if p.exists()]
        pairs.append(StampedPair(stamp, existing((colour or [folder / f"{stem}.color.png"])[0], "colour image"), depth))
        pose = folder / f"{stem}.pose.txt"
        if pose.exists():
            poses.append((stamp, _read_matrix(pose)))
    stated, said = _stated(folder, "camera-intrinsics.txt", folder.parent)
    return _Layout(
        pairs,
        1000.0,
        stated or _KINECT_SEVEN_SCENES,
        poses,
        _KINECT_SEVEN_SCENES_COLOUR,
        assumed=clock.assumed + said,
        usual="" if stated else _usual(_KINECT_SEVEN_SCENES),
    )


def _tum(folder: Path, rate: float | None) -> _Layout:
    pairs, left_out = read_pairs(folder, rate)
    truth = folder / "groundtruth.txt"
    poses = _read_tum(truth) if truth.exists() else []
    if rate is not None:
        left_out["poses, as the stamps of the frames are not those of the recording"] = len(poses)
        poses = []
    camera, (stated, said) = camera_of(folder), _stated(folder, "camera-intrinsics.txt", folder.parent)
    usual = _usual(camera.intrinsics, f"TUM RGB-D publishes for {camera.name}" if camera.name else "")
    return _Layout(
        pairs,
        5000.0,
        stated or camera.intrinsics,
        poses,
        left_out=left_out,
        assumed=said,
        usual="" if stated else usual,
        distortion=() if stated else camera.distortion,
    )


def _plain(folder: Path, clock: Clock) -> _Layout:
    depths = sorted((folder / "depth").iterdir(), key=lambda p: (len(p.stem), p.stem))
    pairs = [
        StampedPair(stamp, existing(folder / "color" / f"{p.stem}.png", "colour image"), p)
        for stamp, p in zip(clock.stamps_ns(len(depths)), depths, strict=True)
    ]
    pose_file = folder / "pose.txt"
    rows = np.loadtxt(read_text(pose_file).splitlines(), ndmin=2) if pose_file.exists() else np.empty((0, 7))
    poses = [(pair.stamp_ns, transform_from_pose7(row)) for pair, row in zip(pairs, rows, strict=False)]
    return _Layout(pairs, 1000.0, _stated(folder, "K.txt")[0], poses, assumed=clock.assumed)


def _numbered(folder: Path, clock: Clock) -> _Layout:
    """Frames of equal name in ``images`` and ``depth``; line k of ``poses.txt`` belongs to the k-th picture."""
    pictures = sorted(p for p in (folder / "images").iterdir() if p.suffix in (".png", ".jpg"))
    stamps = clock.stamps_ns(len(pictures))
    depths = [folder / "depth" / f"{p.stem}.png" for p in pictures]
    pairs = [StampedPair(*frame) for frame in zip(stamps, pictures, depths, strict=True) if frame[2].exists()]
    if not pairs:
        raise ValueError(f"{folder}: no picture of images/ has a depth image of the same name in depth/")
    pose_file = folder / "poses.txt"
    rows = (
        np.loadtxt(read_text(pose_file).splitlines(), ndmin=2).reshape(-1, 4, 4)
        if pose_file.exists()
        else np.empty((0, 4, 4))
    )
    usable = [(stamp, T) for stamp, T in zip(stamps, rows, strict=False) if np.isfinite(T).all()]
    left_out = Counter(
        {
            "pictures without a depth image": len(pictures) - len(pairs),
            "poses that are not finite or have no picture": len(rows) - len(usable),
        }
    )
    poses = [(s, _rigid(T)) for s, T in usable]
    return _Layout(pairs, 1000.0, _stated(folder, "K.txt")[0], poses, left_out=left_out, assumed=clock.assumed)


def _read_tum(path: Path) -> list[tuple[int, FloatArray]]:
    truth = read_trajectory(existing(path, "ground truth"))
    return [(int(stamp), T) for stamp, T in zip(truth.stamps_ns, truth.poses, strict=True)]


def _read_matrix(path: Path) -> FloatArray:
    T = np.loadtxt(read_text(path).splitlines())
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"{path} holds no finite 4x4 pose")
    return _rigid(T)


def _rigid(T: FloatArray) -> FloatArray:
    """A pose stored with few digits, with the nearest rotation."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return make_transform(U @ Vt, T[:3, 3])


def _usual(intrinsics: Intrinsics, published: str = "") -> str:
    fx, fy, cx, cy = intrinsics
    whose = f"as {published}" if published else "usual values, as nothing names the camera"
    return f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}: {whose} (--calibration FILE)"


def _stated(folder: Path, name: str, above: Path | None = None) -> tuple[Intrinsics | None, list[str]]:
    """Intrinsics of the file ``name`` of a folder, or of the one ``above``, which is then said."""
    if (folder / name).exists():
        return _read_camera_matrix(folder / name), []
    if above is not None and (above / name).exists():
        return _read_camera_matrix(above / name), [f"the camera matrix of {above / name}, a folder above the images"]
    return None, []


def _read_camera_matrix(path: Path) -> Intrinsics:
    K = np.loadtxt(read_text(path).splitlines())
    if K.shape != (3, 3):
        raise ValueError(f"{path} holds no 3x3 camera matrix, found {K.shape}")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
