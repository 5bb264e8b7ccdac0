# SPDX-License-Identifier: Apache-2.0
"""Images of an agent chosen by its way, encoded, and kept when the submap in which they were taken has ended.

The submap's own path says where the camera was: a view is placed by the start of its submap, which the map moves.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import FloatArray, boxminus
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, DepthImage, Submap
from slam_radio.views.depth_code import depth_levels
from slam_radio.views.view_config import ViewConfig
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_format import MOST_BYTES, MOST_PIXELS, PlacedImage, pack_view
from slam_radio.wire.view_messages import ViewKey

_MOST_WAITING = 60
"""Images that wait for the end of their submap."""
_STEP_BACK_NS = 1_000_000_000
"""Images of two cameras may come so much out of order."""
_LARGEST_SIGMA_M = 0.12
"""Depth that is less sure is left out."""
_PICTURE_BYTES, _COLOURS_BYTES = MOST_BYTES - 1000, MOST_BYTES // 8
"""Largest JPEG of a picture, and of a dense key frame, whose depth takes most of what may be sent."""
_LEAST_QUALITY = 5


class ViewTaker:
    """Keeps views in ``files``.

    ``dropped``: images without a submap. ``unkept``: why images of the last submap could not be kept.
    """

    def __init__(self, config: ViewConfig, files: ViewFiles) -> None:
        self.config, self.files = config, files
        self.dropped = 0
        self.unkept: list[str] = []
        self._T_odom_base: FloatArray | None = None
        self._last: dict[int, FloatArray] = {}
        self._waiting: deque[PlacedImage] = deque()
        """Of the camera in the rig, without a submap yet."""

    def set_pose(self, T_odom_base: FloatArray) -> None:
        """Take the newest pose by odometry: it says when an image is due."""
        self._T_odom_base = T_odom_base

    def wants(self, kind: int) -> bool:
        """True if an image is far enough from the last one of its kind that was added; the caller then adds it."""
        T = self._T_odom_base
        if T is None:
            return False
        if kind in self._last:
            moved = boxminus(T, self._last[kind])
            near = np.linalg.norm(moved[:3]) < self.config.distance
            if near and np.linalg.norm(moved[3:]) < np.radians(self.config.angle):
                return False
        return True

    def add_picture(self, stamp_ns: int, T_base_camera: FloatArray, picture: ByteArray, camera: Camera | None) -> None:
        """Take a picture (h, w, 3) uint8, red first, and its rectified camera, if that is known."""
        small, share = _narrowed(picture, self.config.width)
        height, width = small.shape[:2]
        known = camera is not None and (camera.width, camera.height) == picture.shape[1::-1]
        intrinsics = _scaled(camera, share) if camera is not None and known else (0.0, 0.0, 0.0, 0.0)
        jpeg = encoded(small, self.config.quality, _PICTURE_BYTES)
        self._wait(PlacedImage(0, 0, stamp_ns, 0, T_base_camera, (width, height), intrinsics, jpeg))

    def add_depth(self, image: DepthImage, T_base_camera: FloatArray, picture: ByteArray | None) -> None:
        """Take a depth image, and a picture (h, w, 3) uint8 in the same pixels, if there is one."""
        step = _spacing(image.depth.shape, self.config.depth_pixels)
        with np.errstate(invalid="ignore"):
            sigma = np.where(image.sigma <= _LARGEST_SIGMA_M, image.sigma, np.float32(np.nan))
        depth, steps = depth_levels(image.depth[::step, ::step], sigma[::step, ::step])
        height, width = depth.shape
        camera = image.camera
        intrinsics = camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step
        jpeg = b""
        if picture is not None and picture.shape[:2] == image.depth.shape:
            small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
            jpeg = encoded(np.asarray(small, dtype=np.uint8), self.config.quality, _COLOURS_BYTES)
        size = width, height
        self._wait(PlacedImage(0, 0, image.stamp_ns, 0, T_base_camera, size, intrinsics, jpeg, depth, steps))

    def _wait(self, view: PlacedImage) -> None:
        if self._T_odom_base is not None:
            self._last[view.kind] = self._T_odom_base
        if self._waiting and view.stamp_ns < self._waiting[-1].stamp_ns - _STEP_BACK_NS:
            self.dropped += len(self._waiting)  # the clock has begun anew: their submap does not come any more
            self._waiting.clear()
        self._waiting.append(view)
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self.dropped += 1

    def end_submap(self, submap: Submap) -> int:
        """Keep the images of a submap that has ended; returns how many. Those of before have none, and are dropped.

        ``unkept`` has the reason for each one that is too large, or whose file cannot be written.
        """
        ready = [view for view in self._waiting if view.stamp_ns <= submap.end_stamp_ns]
        self._waiting = deque(view for view in self._waiting if view.stamp_ns > submap.end_stamp_ns)
        inside = [view for view in ready if view.stamp_ns >= submap.start_stamp_ns] if submap.path else []
        self.dropped += len(ready) - len(inside)
        path = Trajectory.from_estimates(submap.path)
        self.unkept = []
        for view in inside:
            T_start_base = path.interpolate(np.array([view.stamp_ns]))[0]
            try:
                self._keep(view, submap, T_start_base @ view.T_start_camera)
            except (OSError, ValueError) as error:
                self.unkept.append(str(error))
        return len(inside) - len(self.unkept)

    def _keep(self, view: PlacedImage, submap: Submap, T_start_camera: FloatArray) -> None:
        placed = replace(
            view, session=submap.session, index=submap.index, start_stamp_ns=submap.start_stamp_ns,
            T_start_camera=T_start_camera,
        )  # fmt: skip
        self.files.add(ViewKey(placed.kind, placed.session, placed.stamp_ns), pack_view(placed))


def _narrowed(picture: ByteArray, width: int) -> tuple[ByteArray, float]:
    """The picture halved until it is no wider and can be sent, and the share of its size that it has."""
    share = 1.0
    while (picture.shape[1] > width or picture.shape[0] > MOST_PIXELS) and min(picture.shape[:2]) > 1:
        size = picture.shape[1] // 2, picture.shape[0] // 2
        picture, share = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), share / 2
    return picture, share


def _scaled(camera: Camera, share: float) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a picture of ``share`` of the camera's size; a pixel's centre has whole numbers."""
    cx, cy = ((c + 0.5) * share - 0.5 for c in (camera.cx, camera.cy))
    return camera.fx * share, camera.fy * share, cx, cy


def _spacing(shape: tuple[int, ...], most_pixels: int) -> int:
    step = 1
    while -(-shape[0] // step) * -(-shape[1] // step) > most_pixels:
        step *= 2
    return step


def encoded(picture: ByteArray, quality: int, most_bytes: float = np.inf) -> bytes:
    """A JPEG of a picture (h, w, 3), red first; grey if its channels are equal.

    The quality is halved, down to 5 %, until the file has no more than ``most_bytes``.
    """
    is_grey = bool((picture[..., :1] == picture[..., 1:]).all())
    image = np.ascontiguousarray(picture[..., 0] if is_grey else picture[..., ::-1])
    while True:
        data = bytes(cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1])
        if len(data) <= most_bytes or quality <= _LEAST_QUALITY:
            return data
        quality = max(quality // 2, _LEAST_QUALITY)
