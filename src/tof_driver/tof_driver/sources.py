# SPDX-License-Identifier: Apache-2.0
"""Depth images from a folder, a video file or librealsense, without ROS.

A folder holds images of one name in subfolders: ``range`` or ``depth``, and ``amplitude``, ``intensity``, ``color``
where there are such. A video holds them side by side in this order, grey of 16 bits without loss (FFV1). Ranges are
16-bit millimetres, in a folder also float metres (TIFF).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam_core.camera import Camera, CameraInfo
from slam_core.nodes.frame_sources import FrameCapture, images_in, stamp_of_image
from slam_core.types import AnyArray
from tof_driver.stage import RawDepth

_MODELS = {"brown_conrady": "plumb_bob", "none": "none"}
"""librealsense's distortion models that are ours too; depth images of its stereo cameras have none."""
_WAIT_MS = 1000


class DepthFolder:
    """Images of a folder, in the order of their names.

    Stamps are the numbers in the names where those are nanoseconds (15 digits or more), else the count over ``rate``.

    Parameters
    ----------
    names
        Subfolders: the measurement first, then the pictures.

    Raises
    ------
    ValueError
        If there is no image of which all subfolders have one.
    """

    def __init__(self, folder: Path, names: Sequence[str], rate: float = 10.0) -> None:
        self.rate, self._names, self._next = rate, names, 0
        self._paths = [
            [folder / name / image.name for name in names]
            for image in images_in(folder / names[0])
            if all((folder / name / image.name).is_file() for name in names)
        ]
        if not self._paths:
            raise ValueError(f"no images of one name in all of {folder}/{{{','.join(names)}}}")

    def read(self) -> RawDepth | None:
        """The next images, or None after the last; OSError if one cannot be read."""
        if self._next == len(self._paths):
            return None
        paths = self._paths[self._next]
        stamp = stamp_of_image(paths[0], self._next, self.rate)
        self._next += 1
        return _raw_depth(stamp, self._names, [_image(path) for path in paths])

    def close(self) -> None:
        """Nothing to let go of."""


class DepthVideo:
    """Frames of a video file, ``names`` side by side; stamped from zero on. OSError if it cannot be opened."""

    def __init__(self, path: str, names: Sequence[str]) -> None:
        self._names, self._capture = names, FrameCapture(path, raw=True)
        self.rate = self._capture.rate

    def read(self) -> RawDepth | None:
        """The next images, or None at the end; ValueError for a frame that is none of 16-bit grey of that many."""
        read = self._capture.read()
        if read is None:
            return None
        stamp, frame = read
        if frame.ndim != 2 or frame.dtype != np.uint16 or frame.shape[1] % len(self._names):
            raise ValueError(
                f"a frame must be 16-bit grey with {len(self._names)} images of one width side by side"
                f" ({', '.join(self._names)}), got {frame.dtype} {frame.shape}"
            )
        return _raw_depth(stamp, self._names, [np.ascontiguousarray(i) for i in np.hsplit(frame, len(self._names))])

    def close(self) -> None:
        """Let go of the file."""
        self._capture.close()


class RealSense:
    """Depth along z of a RealSense camera, or of a recording of one, by librealsense (``pip install pyrealsense2``).

    Parameters
    ----------
    path
        Serial number of the camera, "" for any, or a recording (.bag) of librealsense.
    clock
        Gives the stamp (ns) when a camera's image has been read; a recording has its own.

    Raises
    ------
    OSError
        If there is no such camera, or librealsense is not installed.
    """

    def __init__(self, path: str, clock: Callable[[], int]) -> None:
        rs = _librealsense()
        config, is_file = rs.config(), Path(path).expanduser().is_file()
        if is_file:
            config.enable_device_from_file(str(Path(path).expanduser()), False)
        elif path:
            config.enable_device(path)
        config.enable_stream(rs.stream.depth, rs.format.z16)
        self._pipeline, self._clock = rs.pipeline(), None if is_file else clock
        try:
            stream = self._pipeline.start(config).get_stream(rs.stream.depth).as_video_stream_profile()
        except RuntimeError as error:
            raise OSError(f"librealsense has no camera or recording '{path}': {error}") from error
        self.rate, self.info = float(stream.fps()), info_of(stream.get_intrinsics())

    def read(self) -> RawDepth | None:
        """The next image, or None at the end of a recording or when the camera has gone."""
        there, frames = self._pipeline.try_wait_for_frames(_WAIT_MS)
        if not there:
            return None
        frame = frames.get_depth_frame()
        return depth_of(frame, round(1e6 * frame.get_timestamp()) if self._clock is None else self._clock())

    def close(self) -> None:
        """Let go of the camera."""
        self._pipeline.stop()


def info_of(intrinsics: Any) -> CameraInfo:
    """Calibration of a stream of librealsense; ValueError for a distortion model that is none of ours."""
    i, model = intrinsics, intrinsics.model.name
    if model not in _MODELS and any(i.coeffs):
        raise ValueError(f"librealsense gives distortion model {model}: set the parameter info to a YAML file")
    distortion = tuple(i.coeffs) if any(i.coeffs) else ()
    kind = _MODELS[model] if distortion else "none"
    return CameraInfo(Camera(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy, kind, distortion))


def depth_of(frame: Any, stamp_ns: int) -> RawDepth:
    """A depth frame of librealsense in metres, 0 where it has none."""
    return RawDepth(stamp_ns, np.asanyarray(frame.get_data()).astype(np.float32) * np.float32(frame.get_units()))


def _librealsense() -> Any:
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise OSError(f"source librealsense needs pip install pyrealsense2, and libusb-1.0: {error}") from error


def _raw_depth(stamp_ns: int, names: Sequence[str], images: Sequence[AnyArray]) -> RawDepth:
    """The measurement and its pictures; a colour picture stands for the amplitude."""
    pictures = {"amplitude" if n == "color" else n: image for n, image in zip(names, images, strict=True)}
    return RawDepth(stamp_ns, images[0], pictures.get("amplitude"), pictures.get("intensity"))


def _image(path: Path) -> AnyArray:
    """An image as stored, colours as grey; OSError if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise OSError(f"cannot read image {path}")
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY))
