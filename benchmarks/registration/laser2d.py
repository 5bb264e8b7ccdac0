"""2D laser logs (CARMEN): scan odometry in the plane and the manual relations of the log."""

from __future__ import annotations

import argparse
import bz2
from itertools import pairwise
from pathlib import Path

import numpy as np

from ndt_registration.pyramid import GridConfig
from ndt_registration.registration import RegistrationConfig, Target, register
from slam_core.geometry import (
    FloatArray,
    euler_from_rotation,
    invert_transform,
    make_transform,
    pose7_from_transform,
    rotation_from_euler,
    transform_from_pose7,
)

MAX_RANGE = 30.0


def pose2(x: float, y: float, yaw: float) -> FloatArray:
    return make_transform(rotation_from_euler(yaw), np.array([x, y, 0.0]))


def read_log(path: Path, every: int) -> list[tuple[float, FloatArray, FloatArray]]:
    """Time s, odometry T_odom_laser and points (n, 2) m of every scan."""
    scans = []
    for line in bz2.decompress(path.read_bytes()).decode("ascii").splitlines():
        words = line.split()
        if words and words[0] == "FLASER":
            n = int(words[1])
            ranges, rest = np.array(words[2 : 2 + n], dtype=float), words[2 + n :]
            angles = np.deg2rad(np.arange(n) * (180.0 / n) - 90.0)
            valid = ranges < MAX_RANGE
            points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[valid]
            scans.append((float(rest[6]), pose2(*(float(v) for v in rest[:3])), points))
    return scans[::every]


def track(scans: list[tuple[float, FloatArray, FloatArray]]) -> tuple[list[FloatArray], int]:
    """Poses by registration to keyframes, from the log's odometry; where a registration fails, the odometry goes on."""
    # 180 beams a degree apart: cells of walls need width, and a beam's neighbour may see past the wall's end.
    grid = GridConfig(voxel_size=0.3, min_points=4, surface_smoothing=0.1)
    config = RegistrationConfig(min_points=30, start_level=1, max_conflict=1.0, grid=grid)
    poses, failures = [scans[0][1]], 0
    key_pose, target = scans[0][1], Target.build(scans[0][2], config)
    for (_, before, _), (_, now, points) in pairwise(scans):
        guess = poses[-1] @ np.linalg.inv(before) @ now
        local = invert_transform(key_pose) @ guess
        result = register(points, target, local, config)
        drift = np.linalg.norm(result.T_target_source[:2, 3] - local[:2, 3])
        good = result.converged and drift < 0.3
        failures += not good
        poses.append(transform_from_pose7(pose7_from_transform(key_pose @ (result.T_target_source if good else local))))
        if not good or result.overlap < 0.7 or np.linalg.norm(local[:2, 3]) > 0.5:
            key_pose, target = poses[-1], Target.build(points, config)
    return poses, failures


def relation_errors(path: Path, times: FloatArray, poses: list[FloatArray]) -> FloatArray:
    """Distance (m) and angle (deg) between each relation and the poses, shape (n, 2)."""
    errors = []
    for line in path.read_text().splitlines():
        t1, t2, x, y, _, _, _, yaw = (float(v) for v in line.split())
        a, b = (int(np.argmin(np.abs(times - t))) for t in (t1, t2))
        d = invert_transform(pose2(x, y, yaw)) @ invert_transform(poses[a]) @ poses[b]
        errors.append((np.hypot(d[0, 3], d[1, 3]), np.rad2deg(abs(euler_from_rotation(d[:3, :3])[0]))))
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with aces.clf.bz2 and aces.relations")
    parser.add_argument("--every", type=int, default=1, help="use every n-th scan")
    arguments = parser.parse_args()
    scans = read_log(arguments.data / "aces.clf.bz2", arguments.every)
    times = np.array([stamp for stamp, _, _ in scans])
    poses, failures = track(scans)
    print(f"aces: {len(scans)} scans, {failures} failed registrations")
    for name, trajectory in (("odometry", [T for _, T, _ in scans]), ("registration", poses)):
        e = relation_errors(arguments.data / "aces.relations", times, trajectory)
        print(
            f"{name:14s} {e[:, 0].mean():.3f} +- {e[:, 0].std():.3f} m, median {np.median(e[:, 0]):.3f} m; "
            f"{e[:, 1].mean():.2f} +- {e[:, 1].std():.2f} deg over {len(e)} relations"
        )


if __name__ == "__main__":
    main()
