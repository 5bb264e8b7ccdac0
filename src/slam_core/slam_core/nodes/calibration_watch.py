# SPDX-License-Identifier: Apache-2.0
"""Notices that a camera's info has changed: its first calibration stays in use, frames under another one are unusable.

A map is made of one calibration. A focal length that changes on the way would bend it without a word.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_core.camera import CameraInfo


class CalibrationWatch:
    """Calibration in use and the newest one heard, by camera."""

    def __init__(self) -> None:
        self._used: dict[str, CameraInfo] = {}
        self._newest: dict[str, CameraInfo] = {}

    def hear(self, camera: str, info: CameraInfo) -> bool:
        """Take a camera's info; True if it is the first, which is to be used."""
        self._newest[camera] = info
        return self._used.setdefault(camera, info) is info

    @property
    def diagnostic(self) -> str:
        """Cameras whose newest info is another than the one in use, and by what, or ""."""
        changed = [_change(name, self._used[name], info) for name, info in self._newest.items()]
        return "; ".join(filter(None, changed))

    def require_unchanged(self) -> None:
        """Refuse images while a node that is not reset hears another calibration.

        Raises
        ------
        ValueError
            With the camera, and what has changed.
        """
        if diagnostic := self.diagnostic:
            raise ValueError(f"{diagnostic}; reset the node (~/reset) to use the new one")

    def restart(self) -> Mapping[str, CameraInfo]:
        """Use the newest calibrations, which are returned by camera."""
        self._used = dict(self._newest)
        return self._used


def same_calibration(a: CameraInfo, b: CameraInfo) -> bool:
    """True if two infos say the same of a camera."""
    return a.camera == b.camera and np.array_equal(a.R, b.R) and np.array_equal(a.P, b.P)


def _change(name: str, used: CameraInfo, newest: CameraInfo) -> str:
    if same_calibration(used, newest):
        return ""
    was, now = used.camera, newest.camera
    if (was.fx, was.fy) != (now.fx, now.fy):
        what = f"fx {was.fx:g} to {now.fx:g} px"
    elif (was.width, was.height) != (now.width, now.height):
        what = f"{was.width} x {was.height} to {now.width} x {now.height} px"
    else:
        what = "same focal length"
    return (
        f"the camera info of {name} has changed ({what}): the first calibration stays in use, images under another "
        "one are left out"
    )
