# SPDX-License-Identifier: Apache-2.0
r"""Dense depth of a stereo pair with the standard deviation of every pixel.

    quarter images -> range of disparities
    halved images  -> semi-global matching -> without what the right camera cannot see
    full images    -> sub-pixel step -> sigma from residual and texture

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

from dense_mapping.keyframes import thinned_camera, thinning
from dense_mapping.stereo_kernels import StepNoise, drop_occluded, refine
from slam_core.config import Config, parameter
from slam_core.types import AnyArray, ByteArray, DepthImage, Float32Array, StereoImages

_BLOCK_SIZE = 11
"""Window that is compared, odd, px."""
_STEP = 16
"""Numbers of disparities that OpenCV searches are multiples of it."""
_REACH = 3.0
"""Disparities are searched so far beyond those of halved images, px."""
_UNIQUENESS_PERCENT = 15
"""Share by which the best disparity must be better than the second best, %."""
_NEARER = 1.0
"""Difference (px) from which the smaller of two disparities that lead to one pixel of the right image is occluded."""
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
_STEP_NOISE = StepNoise(_IMAGE_NOISE, _MATCHED_SIGMA, _SIGMA_SCALE, _SIGMA_FLOOR, _LARGEST_STEP, _LEAST_KNOWN)

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
    """Depth of the left image with sigma, NaN where the disparity is not known, as thinned as a key frame is.

    The left image is the amplitude.
    """
    stereo, spacing = images.stereo, thinning(images.left.shape)
    matched = _checked_disparity(images, config)
    disparity, sigma = refine(images.left, images.right, matched, _WINDOW, spacing, _STEP_NOISE)
    depth = np.float32(stereo.camera.fx * stereo.baseline) / disparity
    amplitude = images.left[::spacing, ::spacing].astype(np.float32)
    camera = thinned_camera(stereo.camera, spacing, amplitude.shape)
    return DepthImage(images.stamp_ns, depth, depth * sigma / disparity, camera, amplitude=amplitude)


def _checked_disparity(images: StereoImages, config: StereoDepthConfig) -> Float32Array:
    """Disparity by matching, NaN where the right camera sees something else or near a jump.

    Matching the other way, too, costs two thirds more and finds little else that is wrong; what there is of it the step
    drops, and what is left other key frames outweigh.
    """
    left, right = (_halved(image, config.max_pixels) for image in (images.left, images.right))
    height, width = images.left.shape
    scale = left.shape[1] / width
    largest = scale * images.stereo.camera.fx * images.stereo.baseline / config.min_depth
    steps = _STEP * max(1, int(np.ceil(min(largest, left.shape[1] / 3.0) / _STEP)))
    steps = _steps_needed(left, right, steps)
    disparity = _match(left, right, steps)
    drop_occluded(disparity, _NEARER, np.empty(disparity.shape[1], np.float32))
    disparity[_near_jump(disparity)] = np.nan
    # Linear: nearest neighbours would make steps of every slanted wall. What has an unknown neighbour gets unknown.
    return np.asarray(cv2.resize(disparity / np.float32(scale), (width, height), interpolation=cv2.INTER_LINEAR))


def _halved(image: ByteArray, max_pixels: int) -> ByteArray:
    """The image, halved until it has no more than so many pixels: matching costs the cube of the width."""
    while image.size > max_pixels:
        image = np.asarray(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return image


def _steps_needed(left: ByteArray, right: ByteArray, most: int) -> int:
    """Disparities to search, in sixteens, for what is in the picture: rooms seldom reach up to ``min_depth``.

    Matching of halved images finds the nearest surface in a tenth of the time.
    """
    if most <= _STEP:
        return most
    small_left, small_right = (_halved(image, image.size // 2) for image in (left, right))
    rough = _match(small_left, small_right, _STEP * int(np.ceil(0.5 * most / _STEP)))
    nearest = 2.0 * float(np.nanmax(rough, initial=0.0)) + _REACH
    return min(most, _STEP * int(np.ceil(nearest / _STEP)))


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
