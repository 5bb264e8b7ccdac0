# SPDX-License-Identifier: Apache-2.0
"""Checks that the IMU reports m/s2 and rad/s, with gravity where down is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding
from slam_core.types import GRAVITY

_FEWEST = 50
_FASTEST_RAD_S = 12.0
_UPRIGHT = 0.5


def check_imu(evidence: Evidence) -> Iterator[Finding]:
    """Units of both halves, and the direction of gravity in base_link."""
    if len(evidence.imu) < _FEWEST:
        return
    topic = evidence.name("imu")
    turn, force = evidence.imu[:, 1:4], evidence.imu[:, 4:7]
    size = float(np.linalg.norm(np.median(force, axis=0)))
    if np.percentile(np.linalg.norm(turn, axis=1), 90) > _FASTEST_RAD_S:
        yield Finding(
            "gyroscope unit",
            f"{topic} turns faster than {_FASTEST_RAD_S:.0f} rad/s much of the time",
            "angular velocity is in rad/s, not deg/s",
        )
    if abs(size - GRAVITY) > 3.0:
        unit = "in g?" if 0.7 < size < 1.3 else "without gravity?" if size < 0.7 else "in another unit?"
        yield Finding(
            "accelerometer unit",
            f"{topic} reports {size:.2f} m/s2 of gravity: {unit}",
            "linear_acceleration is m/s2 with gravity (REP-145)",
        )
        return
    yield from _direction(evidence, np.median(force, axis=0) / size)


def _direction(evidence: Evidence, up: np.ndarray) -> Iterator[Finding]:
    frame = evidence.image_frames.get("imu", "")
    if not evidence.base_frame or frame not in evidence.frames:
        return
    try:
        R = evidence.frames.lookup(evidence.base_frame, frame)[:3, :3]
    except ValueError:
        return
    if evidence.base_frame.endswith("base_link") and (R @ up)[2] < _UPRIGHT:
        x, y, z = R @ up
        yield Finding(
            "gravity",
            f"gravity points against ({x:.1f}, {y:.1f}, {z:.1f}) of {evidence.base_frame}, not z",
            "mend the IMU's mounting, or base_link, which is x forward, z up (REP-103)",
        )
