# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs of planar laser scans with wheel odometry, and the manual relations between their scans."""

from __future__ import annotations

import bz2
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_core.geometry import (
    FloatArray,
    euler_from_rotation,
    invert_transform,
    make_transform,
    rotation_from_euler,
)
from slam_core.types import RelativeMotion

MAX_RANGE = 30.0
WHEEL_NOISE = (0.01, 0.005)
"""Standard deviation of the motion between two scans of a wheel that hardly turns, m and rad."""
WHEEL_SHARE = 0.1
"""And what it grows by with distance and angle."""
TURN_PER_METRE = 0.05
"""Angle by which a metre of way is uncertain, rad."""


@dataclass(frozen=True, eq=False)
class LaserScan:
    """Time s, wheel odometry T_odom_laser (4, 4) and points (n, 2) m."""

    time: float
    T: FloatArray
    points: FloatArray


def pose2(x: float, y: float, yaw: float) -> FloatArray:
    return make_transform(rotation_from_euler(yaw), np.array([x, y, 0.0]))


def read_log(path: Path, every: int = 1) -> list[LaserScan]:
    """The scans of a ``.clf.bz2`` file, half a circle each, those that come out of order left out."""
    scans: list[LaserScan] = []
    for line in bz2.decompress(path.read_bytes()).decode("ascii").splitlines():
        words = line.split()
        if words and words[0] == "FLASER":
            n = int(words[1])
            ranges, rest = np.array(words[2 : 2 + n], dtype=float), words[2 + n :]
            angles = np.deg2rad(np.arange(n) * (180.0 / n) - 90.0)
            points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
            pose = pose2(*(float(v) for v in rest[:3]))
            scan = LaserScan(float(rest[6]), pose, points[ranges < MAX_RANGE])
            if not scans or scan.time > scans[-1].time:
                scans.append(scan)
    return scans[::every]


def wheel_motion(before: LaserScan, now: LaserScan) -> RelativeMotion:
    """The motion between two scans as the wheels saw it; z, roll and pitch are those of the floor."""
    T = invert_transform(before.T) @ now.T
    distance, angle = np.hypot(T[0, 3], T[1, 3]), abs(euler_from_rotation(T[:3, :3])[0])
    along = WHEEL_NOISE[0] + WHEEL_SHARE * distance
    turn = WHEEL_NOISE[1] + WHEEL_SHARE * angle + TURN_PER_METRE * distance
    sigma = np.array([along, along, 1e-4, 1e-4, 1e-4, turn])
    return RelativeMotion(stamp_ns(before), stamp_ns(now), T, np.diag(sigma**2))


def stamp_ns(scan: LaserScan) -> int:
    return int(1e9 * scan.time)


def relation_errors(path: Path, scans: list[LaserScan], poses: list[FloatArray]) -> FloatArray:
    """Distance (m) and angle (deg) between each relation and the poses, shape (n, 2)."""
    times = np.array([scan.time for scan in scans])
    errors = []
    for line in path.read_text().splitlines():
        t1, t2, x, y, _, _, _, yaw = (float(v) for v in line.split())
        a, b = (int(np.argmin(np.abs(times - t))) for t in (t1, t2))
        d = invert_transform(pose2(x, y, yaw)) @ invert_transform(poses[a]) @ poses[b]
        errors.append((np.hypot(d[0, 3], d[1, 3]), np.rad2deg(abs(euler_from_rotation(d[:3, :3])[0]))))
    return np.array(errors)


def relation_spans(path: Path) -> FloatArray:
    """Time s between the two scans of each relation, shape (n,)."""
    stamps = np.loadtxt(path, usecols=(0, 1))
    return np.asarray(np.abs(stamps[:, 1] - stamps[:, 0]))
