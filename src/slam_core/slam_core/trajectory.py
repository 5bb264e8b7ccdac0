# SPDX-License-Identifier: Apache-2.0
"""A trajectory: stamped poses, with or without covariances, and its TUM and CSV files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slam_core.geometry import (
    FloatArray,
    interpolate_transform,
    pose7_from_transform,
    quaternion_from_rotation,
    transform_from_pose7,
)
from slam_core.storage.files import atomic_text, read_text
from slam_core.types import PoseEstimate

Stamps = npt.NDArray[np.int64]

_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses T_parent_rig (n, 4, 4) at stamps_ns (n,), strictly increasing; covariances (n, 6, 6) or None."""

    stamps_ns: Stamps
    poses: FloatArray
    covariances: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.stamps_ns), 4, 4):
            raise ValueError(f"{len(self.stamps_ns)} stamps need poses of shape (n, 4, 4), got {self.poses.shape}")
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ValueError("stamps of a trajectory must be strictly increasing")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def from_estimates(cls, estimates: Iterable[PoseEstimate]) -> Trajectory:
        """Sorted by stamp; of estimates with equal stamps the last one counts."""
        by_stamp = {e.stamp_ns: e for e in estimates}
        ordered = [by_stamp[stamp] for stamp in sorted(by_stamp)]
        if not ordered:
            return cls(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 6, 6)))
        return cls(
            np.array([e.stamp_ns for e in ordered], dtype=np.int64),
            np.stack([e.T for e in ordered]),
            np.stack([e.covariance for e in ordered]),
        )

    @property
    def length_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())

    def select(self, index: npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> Trajectory:
        """The poses at ``index`` (mask or indices)."""
        covariances = None if self.covariances is None else self.covariances[index]
        return Trajectory(self.stamps_ns[index], self.poses[index], covariances)

    def interpolate(self, stamps_ns: Stamps) -> FloatArray:
        """Poses (m, 4, 4) at other stamps; outside the time span the first or last pose."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 0, len(self) - 1)
        before = np.where(self.stamps_ns[after] > stamps_ns, np.maximum(after - 1, 0), after)
        span = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        fraction = np.clip((stamps_ns - self.stamps_ns[before]) / span, 0.0, 1.0)
        return interpolate_transform(self.poses[before], self.poses[after], fraction)


_FEWEST_NS = 10**14
"""A whole number this large is no time in seconds: nanoseconds since 1970, as EuRoC has them."""


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``stamp tx ty tz qx qy qz qw`` lines; the stamp in seconds with all nine decimals."""
    lines = [
        f"{_seconds(stamp)} " + " ".join(f"{v:.9f}" for v in pose7_from_transform(T))
        for stamp, T in zip(trajectory.stamps_ns, trajectory.poses, strict=True)
    ]
    atomic_text(path, "".join(line + "\n" for line in lines))


def read_trajectory(path: Path) -> Trajectory:
    """Read a TUM (8 columns), KITTI (12 columns, the line number as seconds) or EuRoC file (8 or 17 columns, ns).

    Stamps stay exact to the nanosecond; of equal stamps the first counts.

    Raises
    ------
    ValueError
        If a line has the wrong number of columns or anything but finite numbers, or the file holds no pose.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, errors="replace").splitlines(), 1):
        fields = line.split("#")[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            stamp, row = _parse_pose(fields, len(rows))
        except (InvalidOperation, ValueError) as error:
            raise ValueError(f"{path}, line {number}: not a TUM, KITTI or EuRoC pose ({error})") from None
        stamps.append(stamp)
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no poses")
    stamp_array, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    return Trajectory(stamp_array, transform_from_pose7(np.array(rows)[first]))


def _parse_pose(fields: list[str], index: int) -> tuple[int, list[float]]:
    if len(fields) == 12:
        M = np.array([float(v) for v in fields]).reshape(3, 4)
        if abs(np.linalg.det(M[:, :3]) - 1.0) > 0.01:
            raise ValueError("the first three columns are no rotation")
        return index * 10**9, [*M[:, 3], *quaternion_from_rotation(M[:, :3])]
    if len(fields) not in (8, 17):
        raise ValueError(f"{len(fields)} columns")
    is_euroc = len(fields) == 17 or (fields[0].isdigit() and int(fields[0]) >= _FEWEST_NS)
    stamp = int((Decimal(fields[0]) * (1 if is_euroc else 10**9)).to_integral_value())
    if abs(stamp) >= 2**63:
        raise ValueError(f"stamp {fields[0]}")
    row = [float(v) for v in fields[1:8]]
    if is_euroc:  # position, then the quaternion as w x y z
        row = [*row[:3], *row[4:7], row[3]]
    if not np.all(np.isfinite(row)):
        raise ValueError("not finite")
    return stamp, row


def write_covariance_csv(path: Path, trajectory: Trajectory) -> None:
    """Write one row per pose: the stamp and the 21 upper-triangle entries of the 6x6 covariance, row by row.

    Order x, y, z (m), then rotations about the fixed axes X, Y, Z (rad).
    """
    if trajectory.covariances is None:
        raise ValueError("the trajectory has no covariances to write")
    axes = ("x", "y", "z", "rx", "ry", "rz")
    header = "stamp," + ",".join(f"{axes[i]}_{axes[j]}" for i, j in zip(*_UPPER, strict=True))
    rows = [
        f"{_seconds(stamp)}," + ",".join(f"{v:.9e}" for v in P[_UPPER])
        for stamp, P in zip(trajectory.stamps_ns, trajectory.covariances, strict=True)
    ]
    atomic_text(path, "\n".join([header, *rows]) + "\n")


def read_covariance_csv(path: Path) -> tuple[Stamps, FloatArray]:
    """Stamps (n,) and covariances (n, 6, 6) of a file by :func:`write_covariance_csv`."""
    stamps, covariances = [], []
    for number, line in enumerate(read_text(path).splitlines()[1:], 2):
        fields = line.split(",")
        if len(fields) != 22:
            raise ValueError(f"{path}, line {number}: expected 22 columns, found {len(fields)}")
        P = np.zeros((6, 6))
        P[_UPPER] = [float(v) for v in fields[1:]]
        stamps.append(int((Decimal(fields[0]) * 10**9).to_integral_value()))
        covariances.append(P + np.triu(P, 1).T)
    return np.array(stamps, dtype=np.int64), np.array(covariances).reshape(-1, 6, 6)


def _seconds(stamp_ns: int) -> str:
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(int(stamp_ns)) // 10**9}.{abs(int(stamp_ns)) % 10**9:09d}"
