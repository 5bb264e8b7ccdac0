"""Odometry on real depth: 7-Scenes redkitchen, frames 0-199, against the data set's poses."""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ndt_registration.odometry import OdometryConfig, OdometryStatus, ScanOdometry
from slam_core.config import from_mapping
from slam_core.geometry import FloatArray, boxminus, invert_transform
from slam_core.rigid_alignment import umeyama

FOCAL_PX, CENTRE_PX = 585.0, (320.0, 240.0)
PERIOD_NS = 33_333_333


def depth_points(path: Path) -> FloatArray:
    """Points (n, 3) m of a 16-bit depth image in mm, every third pixel."""
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::3, ::3].astype(np.float64) / 1000.0
    v, u = np.mgrid[0:480:3, 0:640:3]
    valid = (depth > 0.3) & (depth < 6.0)
    z = depth[valid]
    return np.column_stack([(u[valid] - CENTRE_PX[0]) / FOCAL_PX * z, (v[valid] - CENTRE_PX[1]) / FOCAL_PX * z, z])


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of frame-*.depth.png and frame-*.pose.txt")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--set", nargs="*", default=[], help="odometry parameters, name=value")
    arguments = parser.parse_args()
    values = {
        name: float(value) if "." in value else int(value) for name, value in (s.split("=") for s in arguments.set)
    }
    odometry = ScanOdometry(from_mapping(OdometryConfig, values))
    estimates, truths, milliseconds, failures = [], [], [], 0
    for k in range(arguments.frames):
        frame = arguments.data / f"frame-{k:06d}"
        points = depth_points(frame.with_suffix(".depth.png"))
        began = time.perf_counter()
        result = odometry.process(1 + k * PERIOD_NS, points)
        milliseconds.append(1e3 * (time.perf_counter() - began))
        failures += result.status in (OdometryStatus.FAILED, OdometryStatus.RESTARTED)
        estimates.append(result.T)
        truths.append(np.loadtxt(frame.with_suffix(".pose.txt")))
    start = invert_transform(truths[0])
    errors = np.array([boxminus(T, start @ G) for T, G in zip(estimates, truths, strict=True)])
    length = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(truths))
    distance, angle = np.linalg.norm(errors[:, :3], axis=1), np.rad2deg(np.linalg.norm(errors[:, 3:], axis=1))
    fit = umeyama(np.array([T[:3, 3] for T in estimates]), np.array([T[:3, 3] for T in truths]))
    apart = [
        np.linalg.norm(fit[:3, :3] @ T[:3, 3] + fit[:3, 3] - G[:3, 3]) for T, G in zip(estimates, truths, strict=True)
    ]
    steps = np.array([
        boxminus(invert_transform(a) @ b, invert_transform(g) @ h)
        for a, b, g, h in zip(estimates[:-1], estimates[1:], truths[:-1], truths[1:], strict=True)
    ])  # fmt: skip
    print(f"path {length:.2f} m, {len(estimates)} frames, {failures} failed")
    print(f"ATE (aligned): rmse {rms(np.array(apart)):.4f} m")
    end = 100 * distance[-1] / length
    print(f"from the start: rmse {rms(distance):.4f} m, end {distance[-1]:.4f} m ({end:.2f} %), {angle[-1]:.2f} deg")
    moved, turned = (np.median(np.linalg.norm(part, axis=1)) for part in (steps[:, :3], steps[:, 3:]))
    print(f"between frames: median {1e3 * moved:.2f} mm, {np.rad2deg(turned):.3f} deg")
    ms = np.array(milliseconds[1:])
    print(f"time per frame: median {np.median(ms):.1f} ms, 95 % below {np.percentile(ms, 95):.1f} ms")


if __name__ == "__main__":
    main()
