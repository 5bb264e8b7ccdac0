# SPDX-License-Identifier: Apache-2.0
r"""Dense depth of a stereo pair with the standard deviation of every pixel.

    halved images -> semi-global matching, both ways -> left-right check
    full images   -> sub-pixel step -> sigma from residual and texture

Semi-global matching (Hirschmueller 2008, OpenCV) fills textureless walls with whatever is smooth. What tells a
measured disparity from a guessed one is the image itself: the right image, warped by the disparity, leaves a residual
``r``, and a window whose gradient along the row is ``g`` fixes the disparity to ``s^2 = var(r) / sum(g^2)`` (the
Cramer-Rao bound of a shift). The same sums give the Gauss-Newton step ``sum(g r) / sum(g^2)``, which removes the
matcher's preference for whole pixels. Where there is no texture the matcher's own disparity, an observation with the
sigma that its errors were found to have, outweighs that step.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.types import AnyArray, ByteArray, DepthImage, Float32Array, StereoImages

_BLOCK_SIZE = 11
"""Window that is compared, odd, px."""
_UNIQUENESS_PERCENT = 15
"""Share by which the best disparity must be better than the second best, %."""
_MAX_LEFT_RIGHT = 0.5
"""Largest difference between the disparities left to right and right to left, px."""
_SPECKLE_SIZE = 200
"""Islands of disparity up to this size are dropped, px."""
_EDGE_RADIUS = 2
"""Pixels so near a jump of disparity are dropped: the matcher widens near objects, px."""
_JUMP = 3.0
"""Difference of disparities within :data:`_EDGE_RADIUS` that is a jump, px."""
_WINDOW = 15
"""Window of the sub-pixel step and of sigma, odd, px."""
_IMAGE_NOISE = 2.0
"""Standard deviation of a grey value."""
_SIGMA_SCALE = 2.0
"""Factor on the standard deviation from residual and gradient: neighbours share their errors."""
_SIGMA_FLOOR = 0.12
"""Standard deviation of a perfect window's disparity, px."""
_MATCHED_SIGMA = 0.5
"""Standard deviation of what the matcher alone says, px."""
_LARGEST_STEP = 0.6
"""Disparities that the step moves by more are dropped: matcher and picture contradict each other, px."""
_LEAST_KNOWN = 0.9
"""Share of a window whose disparity is known, below which its middle is dropped: a hole is an edge as a rule."""

Mask = npt.NDArray[np.bool_]

_SUBPIXELS = 16.0
"""OpenCV gives disparities in sixteenths of a pixel."""
_FAR_PX = 1e6


@dataclass(frozen=True)
class StereoDepthConfig(Config):
    """Semi-global matching and the noise of its disparities.

    Pixels of the matching, up to ``jump``, are those of the halved images.
    """

    min_depth: float = parameter(0.3, "nearest depth that is searched", unit="m", minimum=0.05)
    max_pixels: int = parameter(
        240000, "larger images are halved for matching until they have no more pixels", unit="px", minimum=1000
    )


def stereo_depth(images: StereoImages, config: StereoDepthConfig) -> DepthImage:
    """Depth of the left image with sigma; NaN where the disparity is not known. The left image is the amplitude."""
    disparity, sigma = _disparity(images, config)
    stereo = images.stereo
    with np.errstate(invalid="ignore"):
        depth = (np.float32(stereo.camera.fx * stereo.baseline) / disparity).astype(np.float32)
        sigma_depth = (depth * sigma / disparity).astype(np.float32)
    return DepthImage(images.stamp_ns, depth, sigma_depth, stereo.camera, amplitude=images.left.astype(np.float32))


def _disparity(images: StereoImages, config: StereoDepthConfig) -> tuple[Float32Array, Float32Array]:
    """Disparity and its standard deviation (height, width) px, NaN where either is not trusted."""
    disparity = _checked_disparity(images, config)
    refined, sigma = _refined(images.left, images.right, disparity)
    dropped = np.isnan(sigma) | ~(np.abs(refined - disparity) < _LARGEST_STEP) | ~(refined > 0.5)
    refined[dropped] = np.nan
    sigma[dropped] = np.nan
    return refined, sigma


def _checked_disparity(images: StereoImages, config: StereoDepthConfig) -> Float32Array:
    """Disparity by matching both ways, NaN where the two disagree or near a jump."""
    left, right = (_halved(image, config.max_pixels) for image in (images.left, images.right))
    height, width = images.left.shape
    scale = left.shape[1] / width
    largest = scale * images.stereo.camera.fx * images.stereo.baseline / config.min_depth
    steps = 16 * max(1, int(np.ceil(min(largest, left.shape[1] / 3.0) / 16.0)))
    disparity = _match(left, right, steps)
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in (right, left)]
    back = _match(mirrored[0], mirrored[1], steps)[:, ::-1]
    disparity[_disagrees(disparity, back, _MAX_LEFT_RIGHT)] = np.nan
    disparity[_near_jump(disparity)] = np.nan
    # Linear: nearest neighbours would make steps of every slanted wall. What has an unknown neighbour gets unknown.
    return np.asarray(cv2.resize(disparity / np.float32(scale), (width, height), interpolation=cv2.INTER_LINEAR))


def _halved(image: ByteArray, max_pixels: int) -> ByteArray:
    """The image, halved until it has no more than so many pixels: matching costs the cube of the width."""
    while image.size > max_pixels:
        image = np.asarray(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return image


def _match(image: ByteArray, other: ByteArray, steps: int) -> Float32Array:
    area = _BLOCK_SIZE**2
    # Columns left of the first disparity cannot be matched: widened images keep the left edge of the picture.
    padded = [cv2.copyMakeBorder(i, 0, 0, steps, 0, cv2.BORDER_REPLICATE) for i in (image, other)]
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=steps,
        blockSize=_BLOCK_SIZE,
        P1=8 * area,
        P2=64 * area,
        preFilterCap=31,
        uniquenessRatio=_UNIQUENESS_PERCENT,
        speckleWindowSize=_SPECKLE_SIZE,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*padded)[:, steps:].astype(np.float32) / np.float32(_SUBPIXELS)
    disparity[disparity <= 0.0] = np.nan
    return disparity


def _disagrees(left: Float32Array, right: Float32Array, most: float) -> Mask:
    """Mask of left pixels whose partner does not point back to them; (height, width)."""
    rows, columns = np.indices(left.shape)
    partner = np.rint(columns - np.nan_to_num(left)).astype(np.int64)
    inside = partner >= 0
    back = right[rows, np.maximum(partner, 0)]
    return _mask(~(inside & (np.abs(left - back) <= most)))


def _near_jump(disparity: Float32Array) -> Mask:
    """Within ``edge_radius`` of a jump; a slope as steep as a floor is none."""
    if _EDGE_RADIUS == 0:
        return np.zeros(disparity.shape, dtype=bool)
    known = np.isfinite(disparity)
    window = np.ones((2 * _EDGE_RADIUS + 1,) * 2, np.uint8)
    lowest = cv2.erode(np.where(known, disparity, _FAR_PX).astype(np.float32), window)
    highest = cv2.dilate(np.where(known, disparity, -_FAR_PX).astype(np.float32), window)
    return _mask((highest - lowest > _JUMP) & (highest > 0.0) & (lowest < _FAR_PX))


def _mask(values: AnyArray) -> Mask:
    return np.asarray(values, dtype=np.bool_)


def _refined(left: ByteArray, right: ByteArray, disparity: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Disparity after one Gauss-Newton step, and its standard deviation, from a window around each pixel.

    The matcher's disparity counts as an observation of its own: without texture the step is short instead of wild.
    """
    known = np.isfinite(disparity)
    warped = _warped(right, np.where(known, disparity, np.float32(0.0)))
    image = left.astype(np.float32)
    gradient = 0.5 * (_along_row(image) + _along_row(warped))
    residual = warped - image
    sums = _WindowSums(known, _WINDOW)
    offset, slope = sums(residual) / sums.count, sums(gradient) / sums.count
    noise = np.float32(_IMAGE_NOISE**2)
    energy = np.maximum(sums(gradient**2) - sums.count * (slope**2 + 0.25 * noise), 1e-3)
    product = sums(gradient * residual) - sums.count * slope * offset
    variance = np.maximum(sums(residual**2) / sums.count - offset**2, 2.0 * noise)
    # warped(u) = R(u - d): a larger d moves the right image to the right, so dr/dd = -g.
    spread = _SIGMA_SCALE**2 * variance
    information = energy + spread / _MATCHED_SIGMA**2
    refined = np.where(known, disparity + product / information, np.nan).astype(np.float32)
    sigma = np.hypot(np.sqrt(spread / information), _SIGMA_FLOOR)
    known = known & (sums.count >= _LEAST_KNOWN * _WINDOW**2)
    return refined, np.where(known, sigma, np.nan).astype(np.float32)


def _warped(right: ByteArray, disparity: Float32Array) -> Float32Array:
    """The right image as seen through the disparity of every left pixel."""
    rows, columns = np.indices(disparity.shape)
    u = np.asarray(columns - disparity, dtype=np.float32)
    v = np.asarray(rows, dtype=np.float32)
    image = right.astype(np.float32)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _along_row(image: Float32Array) -> Float32Array:
    kernel = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel))


class _WindowSums:
    """Sums over the window around each pixel, of known pixels only."""

    def __init__(self, known: Mask, window: int) -> None:
        self._known, self._window = known.astype(np.float32), window
        self.count: Float32Array = np.maximum(self(np.ones_like(self._known)), np.float32(1.0))

    def __call__(self, values: Float32Array) -> Float32Array:
        size, border = (self._window, self._window), cv2.BORDER_REPLICATE
        return np.asarray(cv2.boxFilter(values * self._known, cv2.CV_32F, size, normalize=False, borderType=border))
