# SPDX-License-Identifier: Apache-2.0
"""The readout of one camera's rolling shutter, from several recordings of it.

A short recording shows the readout too badly to be corrected, and its lengths then err by the way that the camera moves
while a picture is read out: maps of one building by one camera differ in scale, and merging bends them. What the other
recordings of the camera show is known beforehand where it is certain and the recording itself does not contradict it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam_core.camera import CameraInfo

_CERTAIN = 6.0
"""Standard errors by which the readout must differ from zero, as for the filter itself."""
_CONTRADICTION = 4.0
"""Standard deviations by which a recording may differ from the others."""


@dataclass(frozen=True)
class SeenReadout:
    """Readout of a camera and its standard error, s, as frames show it, certain or not; zeros where they show nothing.

    camera: key of the camera; empty where the readout is not to be shared.
    """

    camera: str
    value_s: float
    sigma_s: float

    @property
    def parameters(self) -> dict[str, dict[str, float]]:
        """The parameters of the filter that say so."""
        return {"ekf_slam": {"measurement.readout": self.value_s, "measurement.sigma_readout": self.sigma_s}}

    @property
    def text(self) -> str:
        """A line for the user."""
        return (
            f"mapped with the readout of its rolling shutter that other recordings show, "
            f"{1e3 * self.value_s:.1f} +- {1e3 * self.sigma_s:.1f} ms"
        )


def camera_key(info: CameraInfo | None) -> str:
    """Key of a camera by its calibration, the same in all its recordings; empty without one."""
    if info is None:
        return ""
    camera = info.camera
    numbers = [camera.width, camera.height, camera.K.tolist(), camera.distortion, info.R.tolist(), info.P.tolist()]
    return hashlib.sha256(repr(numbers).encode()).hexdigest()


def readouts_of_others(seen: Sequence[SeenReadout]) -> list[SeenReadout | None]:
    """For each recording what the others of its camera show, or None where that is not certain or not its own."""
    return [_of_others(k, seen) for k in range(len(seen))]


def _of_others(k: int, seen: Sequence[SeenReadout]) -> SeenReadout | None:
    own = seen[k]
    others = [s for i, s in enumerate(seen) if i != k and s.camera == own.camera and s.sigma_s > 0.0]
    if not others or not own.camera:
        return None
    others.sort(key=lambda s: (s.value_s, s.sigma_s))  # the same sum in any order of the recordings
    values, weights = np.array([s.value_s for s in others]), np.array([s.sigma_s for s in others]) ** -2.0
    mean, sigma = float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)
    contradicts = abs(own.value_s - mean) > _CONTRADICTION * np.hypot(own.sigma_s, sigma) and own.sigma_s > 0.0
    if abs(mean) <= _CERTAIN * sigma or contradicts:
        return None
    return SeenReadout(own.camera, mean, sigma)
