# SPDX-License-Identifier: Apache-2.0
"""Rectification of a raw stereo pair from its two camera infos.

Thesis section 2.4, Hartley and Zisserman section 11.12.

After it, both images have one camera model without distortion, corresponding points lie on the same row and
``disparity = u_left - u_right`` is positive. The maps are computed once per calibration.
"""

from __future__ import annotations

import cv2
import numpy as np

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray, MakeColour, StereoImages, no_colour

_OUTSIDE = -10.0
_MINIMUM_BASELINE = 1e-4


def stereo_camera_from_infos(left: CameraInfo, right: CameraInfo) -> StereoCamera:
    """The rectified pair that two camera infos describe.

    Raises
    ------
    ValueError
        If the sizes differ, if there is no baseline in P, or if left and right are swapped.
    """
    sizes = [(i.camera.width, i.camera.height) for i in (left, right)]
    if sizes[0] != sizes[1]:
        raise ValueError(f"left and right camera infos differ in size: {sizes[0]} and {sizes[1]} px")
    if abs(left.baseline) < _MINIMUM_BASELINE and abs(right.baseline) < _MINIMUM_BASELINE:
        raise ValueError(
            "neither camera info has a baseline, P[0, 3] is zero in both: calibrate the pair (slam calibrate stereo)"
        )
    baseline = right.baseline - left.baseline
    if baseline < 0.0:
        raise ValueError(
            f"left and right are swapped: the right camera lies {-baseline:.4f} m to the left of the left one "
            f"(P[0, 3] is {left.P[0, 3]:.3f} left, {right.P[0, 3]:.3f} right; the right one must be -fx * baseline)"
        )
    return StereoCamera(left.rectified, baseline)


class Rectifier:
    """Maps raw images of one camera to a rectified camera; an image that already is rectified passes through.

    Parameters
    ----------
    info
        K, D and R of the raw image.
    target
        The rectified camera; by default the one in ``info.P``.
    """

    def __init__(self, info: CameraInfo, target: Camera | None = None) -> None:
        self.source = info.camera
        self.camera = target or info.rectified
        passes = info.is_rectified and np.allclose(self.camera.K, info.camera.K, atol=1e-6)
        self._maps = None if passes else _fixed_point_maps(info, self.camera)

    def __call__(self, image: ByteArray) -> ByteArray:
        """Rectified image, uint8 (height, width).

        Raises
        ------
        ValueError
            If the image is not uint8 grey or not of the size of the camera info.
        """
        if image.ndim != 2:
            raise ValueError(f"a camera image must be grey (height, width), got {image.shape}")
        return self._mapped(image)

    def colour(self, image: ByteArray) -> ByteArray:
        """Rectified image in colour, uint8 (height, width, 3); ValueError as for a grey one."""
        return self._mapped(image)

    def _mapped(self, image: ByteArray) -> ByteArray:
        _check_image(image, self.source)
        if self._maps is None:
            # Not the image itself: a message's is read-only, for which every kernel would be compiled once more.
            return image.copy()
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


class StereoRectifier:
    """Turns raw pairs into :class:`StereoImages`.

    Both images are mapped to the left camera's P, so a right P with another principal point needs no offset later.

    Parameters
    ----------
    left, right
        Camera infos as calibrated: ``right.P[0, 3] = -fx * baseline``.
    """

    def __init__(self, left: CameraInfo, right: CameraInfo) -> None:
        self.stereo = stereo_camera_from_infos(left, right)
        self._left = Rectifier(left, self.stereo.camera)
        self._right = Rectifier(right, self.stereo.camera)

    def __call__(
        self, stamp_ns: int, left: ByteArray, right: ByteArray, colour: MakeColour = no_colour
    ) -> StereoImages:
        """Rectify one pair of raw images, uint8 (height, width) each, of one stamp; ``colour``: the left one's."""

        def rectified_colour() -> ByteArray | None:
            raw = colour()
            return None if raw is None else self._left.colour(raw)

        return StereoImages(stamp_ns, self._left(left), self._right(right), self.stereo, colour=rectified_colour)


def rectification_map(info: CameraInfo, target: Camera) -> FloatArray:
    """Raw pixel (u, v) of every pixel of the rectified image ``target``.

    Shape (height, width, 2), NaN behind the camera.
    """
    u, v = np.meshgrid(np.arange(target.width, dtype=np.float64), np.arange(target.height, dtype=np.float64))
    rays = target.unproject(np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size)) @ info.R
    return info.camera.project(rays).reshape(target.height, target.width, 2)


def _fixed_point_maps(info: CameraInfo, target: Camera) -> tuple[AnyArray, AnyArray]:
    pixels = np.nan_to_num(rectification_map(info, target), nan=_OUTSIDE).astype(np.float32)
    fixed, fraction = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
    return fixed, fraction


def _check_image(image: ByteArray, camera: Camera) -> None:
    if image.dtype != np.uint8:
        raise ValueError(f"a camera image must be uint8, got {image.dtype}")
    expected = (camera.height, camera.width)
    if image.shape[:2] != expected:
        raise ValueError(f"image (height, width) is {image.shape[:2]} px but its camera info says {expected} px")
