# SPDX-License-Identifier: Apache-2.0
"""The ToF driver without ROS: raw images in, rectified depth with its noise out, once the calibration is known."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from slam_core.camera import CameraInfo
from slam_core.types import AnyArray, ByteArray, Counters, DepthImage
from tof_driver.depth import DepthConfig, DepthProcessor

WAITING = 100
"""Images kept while no camera info has come."""
FEW_PIXELS = 0.05
"""A smaller share of pixels with depth is a complaint."""


@dataclass(frozen=True, eq=False)
class RawDepth:
    """Images of one instant as the camera gives them: range or depth (uint16 mm or float m), pictures beside it."""

    stamp_ns: int
    image: AnyArray
    amplitude: AnyArray | None = None
    intensity: AnyArray | None = None
    frame_id: str = "tof_optical_frame"


class DepthStage:
    """Keeps raw images until the camera info is there; ``counters`` tells what became of their pixels."""

    def __init__(self, config: DepthConfig) -> None:
        self.info: CameraInfo | None = None
        self.diagnostic = ""
        """Fault of the newest image, or ""."""
        self._config = config
        self._processor: DepthProcessor | None = None
        self._waiting: deque[RawDepth] = deque()
        self._dropped = 0

    @property
    def counters(self) -> dict[str, int]:
        """Counts of what was accepted and rejected, by name."""
        counts = {} if self._processor is None else dict(self._processor.counters.counts)
        return counts | ({"images_without_camera_info": self._dropped} if self._dropped else {})

    def set_info(self, info: CameraInfo) -> None:
        """Use a calibration; one that says the same as before changes nothing."""
        known = self.info
        if known is not None and known.camera == info.camera and np.array_equal(known.P, info.P):
            return
        counters = Counters() if self._processor is None else self._processor.counters
        self._processor = DepthProcessor(self._config, info.camera, info.rectified)
        self._processor.counters = counters
        self.info = info

    def add(self, raw: RawDepth) -> None:
        """Take the images of one instant; :meth:`ready` returns what becomes of them."""
        self._waiting.append(raw)
        if self._processor is None and len(self._waiting) > WAITING:
            self._waiting.popleft()
            self._dropped += 1

    def ready(self) -> Iterator[DepthImage]:
        """Depth of every image whose calibration is known, oldest first.

        Raises
        ------
        ValueError
            If an image does not fit the calibration; the ones after it are kept.
        """
        while self._processor is not None and self._waiting:
            raw = self._waiting.popleft()
            depth = self._processor.process(raw.stamp_ns, raw.image, raw.amplitude, raw.intensity)
            share = self._processor.share_with_depth
            self.diagnostic = f"{100.0 * share:.1f} % of the pixels have depth" if share < FEW_PIXELS else ""
            yield replace(depth, frame_id=raw.frame_id)

    def colour(self, picture: ByteArray) -> ByteArray | None:
        """A picture (h, w, 3) uint8 in the pixels of the raw depth image, rectified as that is; None: no calibration.

        Raises
        ------
        ValueError
            For a picture of another size.
        """
        return None if self._processor is None else self._processor.colour(picture)

    def reset(self) -> None:
        """Forget what waits; the calibration stays."""
        self._waiting.clear()
