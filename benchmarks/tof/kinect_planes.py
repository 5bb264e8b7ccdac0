# SPDX-License-Identifier: Apache-2.0
"""Noise of a real structured-light camera on flat surfaces against the driver's sigma (7-Scenes redkitchen, Kinect v1).

    python benchmarks/tof/kinect_planes.py

Square windows of the depth image in which one plane explains at least 98 % of the pixels are taken for flat. Per depth:
the spread (robust, from quartiles) of depth about the plane, the sigma that the driver states, and their ratio. Data:
$INDOOR_SLAM_DATA or ../shared/data.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import numpy as np

from slam_core.camera import Camera
from slam_core.config import from_mapping
from slam_core.geometry import FloatArray
from slam_core.types import DepthImage
from tof_driver.depth import DepthConfig, DepthProcessor

DATA = Path(os.environ.get("INDOOR_SLAM_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
WINDOW, STEP = 40, 20
CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)


def flat_windows(image: DepthImage) -> list[tuple[float, float, float]]:
    """(depth, spread about the plane, stated sigma), m, of each flat window."""
    found = []
    v, u = np.mgrid[:WINDOW, :WINDOW].reshape(2, -1) - 0.5 * (WINDOW - 1)
    A = np.column_stack([u, v, np.ones(WINDOW * WINDOW)])
    for row in range(0, 480 - WINDOW + 1, STEP):
        for column in range(0, 640 - WINDOW + 1, STEP):
            window = slice(row, row + WINDOW), slice(column, column + WINDOW)
            z, sigma = image.depth[window].ravel().astype(np.float64), image.sigma[window].ravel()
            valid = np.isfinite(z)
            if valid.mean() > 0.98 and (spread := _spread(A[valid], z[valid])) is not None:
                found.append((float(np.median(z[valid])), spread, float(np.median(sigma[valid]))))
    return found


def _spread(A: FloatArray, z: FloatArray) -> float | None:
    """Spread of depth about the plane (linear in inverse depth), None if the window is not flat."""
    w = np.ones(len(z))
    for _ in range(5):
        plane = np.linalg.lstsq(A * w[:, None], w / z, rcond=None)[0]
        error = z - 1.0 / (A @ plane)
        scale = max(1.4826 * float(np.median(np.abs(error))), 1e-5)
        w = 1.0 / np.maximum(1.0, np.abs(error) / scale)
    quartiles = np.percentile(error, [25, 75])
    return float(quartiles[1] - quartiles[0]) / 1.349 if np.mean(np.abs(error) < 3.5 * scale) > 0.98 else None


def main() -> None:
    processor = DepthProcessor(from_mapping(DepthConfig, {"measurement": "depth"}), CAMERA)
    rows, durations = [], []
    for path in sorted((DATA / "rgbd_tsdf_1000" / "data").glob("*.depth.png"))[::20]:
        raw = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        start = time.perf_counter()
        image = processor.process(0, raw)
        durations.append(time.perf_counter() - start)
        rows += flat_windows(image)
    depth, spread, sigma = np.array(rows).T
    print(f"{'depth [m]':>12s} {'windows':>8s} {'spread [mm]':>12s} {'stated [mm]':>12s} {'ratio':>6s}")
    for low in np.arange(0.5, 4.5, 0.5):
        chosen = (depth >= low) & (depth < low + 0.5)
        if chosen.sum() >= 10:
            s, t = np.median(spread[chosen]), np.median(sigma[chosen])
            print(f"{low:5.1f} - {low + 0.5:4.1f} {chosen.sum():8d} {1e3 * s:12.2f} {1e3 * t:12.2f} {s / t:6.2f}")
    print(f"{1e3 * np.median(durations):.1f} ms per image of 640 x 480 px")


if __name__ == "__main__":
    main()
