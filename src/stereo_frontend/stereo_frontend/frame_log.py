# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run with the features found in them: some of its frames, evenly spread, however long it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slam_core.types import ByteArray, Features
from stereo_frontend.depth.tof_features import normalised_picture
from stereo_frontend.detection.annotate import annotated_image
from stereo_frontend.stage import ExtractedFrame

_MOST = 1500
"""Frames kept; beyond that every other one goes."""
_APART_NS = 270_000_000
"""From one frame that is kept to the next: to draw and pack a picture takes 3 ms."""
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 85)
_CLIP, _GAMMA = 0.005, 0.7
"""Share of the darkest and of the brightest pixels of a depth camera that are not told apart, and exponent."""


@dataclass(frozen=True, eq=False)
class LoggedFrame:
    """A JPEG file of the picture with its features drawn, and the features, without descriptors."""

    jpeg: bytes
    features: Features

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame."""
        return self.features.stamp_ns

    @property
    def picture(self) -> ByteArray:
        """The picture (h, w, 3) uint8, red first."""
        image = cv2.imdecode(np.frombuffer(self.jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert image is not None, "written by ourselves"
        return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


class FrameLog:
    """Keeps up to four frames a second, of a long run fewer: between 750 and 1500 in all."""

    def __init__(self) -> None:
        self.frames: list[LoggedFrame] = []
        self._apart_ns = _APART_NS

    def add(self, frame: ExtractedFrame, features: Features) -> None:
        """Take one more frame with what was found in it."""
        if self.frames and features.stamp_ns - self.frames[-1].stamp_ns < self._apart_ns:
            return
        self.frames.append(_logged(frame, features))
        if len(self.frames) > _MOST:
            self.frames = self.frames[::2]
            self._apart_ns *= 2


def _logged(frame: ExtractedFrame, features: Features) -> LoggedFrame:
    _, jpeg = cv2.imencode(".jpg", annotated_image(_picture(frame), features), _JPEG)
    bare = replace(features, descriptors=np.empty((len(features), 0), dtype=np.float32))
    return LoggedFrame(jpeg.tobytes(), bare)


def _picture(frame: ExtractedFrame) -> ByteArray:
    """The left image in its colours, or what a depth camera gives beside depth, or depth itself."""
    if frame.images is not None:
        return frame.images.picture()
    assert frame.depth is not None, "a frame has one or the other"
    depth = frame.depth
    picture = next((p for p in (depth.amplitude, depth.intensity) if p is not None), depth.depth)
    return normalised_picture(picture, _CLIP, _GAMMA)
