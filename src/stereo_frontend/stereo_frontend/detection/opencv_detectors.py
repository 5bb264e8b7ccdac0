# SPDX-License-Identifier: Apache-2.0
"""OpenCV's detectors behind the one detector interface; binary descriptors become unit-norm float vectors.

A binary string of n bits becomes a vector of +-1/sqrt(n), so that the scalar product (Eq. 3.1) is ``1 - 2 hamming / n``
and one matcher serves all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from slam_core.types import AnyArray, ByteArray, Float32Array
from stereo_frontend.keypoints import MOST_KEYPOINTS, DescribesAtOnce, Keypoints, Selector

SIFT_CONTRAST = 0.04
"""Contrast threshold of Lowe 2004 as OpenCV scales it."""
FAST_THRESHOLD = 20.0


class OpenCvDetector(DescribesAtOnce):
    """One of OpenCV's detectors with descriptors: ``sift``, ``rootsift`` or ``orb``.

    ``rootsift`` is the square root of the L1-normalised SIFT vector (Arandjelovic and Zisserman 2012).
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._make, self._normalise = _KINDS[name]

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Keypoints above ``threshold`` times the customary one, thinned out by ``select``."""
        found, raw = self._make(threshold).detectAndCompute(image, None)
        if raw is None or len(found) == 0:
            return Keypoints.none()
        uv = np.array([k.pt for k in found], np.float32)
        response = np.array([k.response for k in found], np.float32)
        size = np.array([k.size for k in found], np.float32)
        kept = _without_repeats(uv, select(uv, size, response))
        return Keypoints(uv[kept], size[kept], response[kept], self._normalise(raw[kept]))


def unit_norm(vectors: AnyArray) -> Float32Array:
    """Rows (n, d) scaled to unit length; rows of zeros stay."""
    vectors = vectors.astype(np.float32)
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(norm, np.float32(1e-12)), np.float32)


def root_normalised(vectors: AnyArray) -> Float32Array:
    """Square roots of the L1-normalised rows: the Hellinger kernel as a scalar product."""
    vectors = vectors.astype(np.float32)
    return np.asarray(np.sqrt(vectors / np.maximum(vectors.sum(axis=1, keepdims=True), np.float32(1e-12))), np.float32)


def from_bits(packed: AnyArray) -> Float32Array:
    """Binary strings, uint8 (n, bytes), as unit vectors (n, 8 bytes)."""
    bits = np.unpackbits(packed.astype(np.uint8), axis=1).astype(np.float32)
    return np.asarray((2.0 * bits - 1.0) / np.sqrt(np.float32(bits.shape[1])), np.float32)


def _without_repeats(uv: Float32Array, kept: AnyArray) -> AnyArray:
    """Drop later keypoints on the same pixel (SIFT gives one per orientation): two landmarks there help nobody."""
    _, first = np.unique(uv[kept], axis=0, return_index=True)
    return kept[np.sort(first)]


def _sift(threshold: float) -> Any:
    return cv2.SIFT.create(0, 3, SIFT_CONTRAST * threshold)


def _orb(threshold: float) -> Any:
    fast = int(np.clip(round(FAST_THRESHOLD * threshold), 2, 120))
    return cv2.ORB.create(nfeatures=MOST_KEYPOINTS, fastThreshold=fast)


_KINDS: dict[str, tuple[Callable[[float], Any], Callable[[AnyArray], Float32Array]]] = {
    "sift": (_sift, unit_norm),
    "rootsift": (_sift, root_normalised),
    "orb": (_orb, from_bits),
}
