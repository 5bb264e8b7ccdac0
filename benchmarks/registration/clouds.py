# SPDX-License-Identifier: Apache-2.0
"""Public clouds without an initial guess: ETH apartment, PCL pairs, vehicle lidar, five RGB-D views (slambook).

Where a data set has a transform, the difference from it is printed, and how far the registration leaves it when it
starts there, which is what data and transform disagree by.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ndt_registration.cloud_io import read_cloud
from ndt_registration.registration import register
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_log, transform_from_pose7

TUTORIAL = "cloud_libpointmatcher/icp_tutorial"
RGBD = "rgbd_slambook5/ch5/rgbd"
FX, FY, CX, CY = 518.0, 519.0, 325.5, 253.5
STRIDE = 3


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds (n, 3) m, and T_target_source where it is known."""

    name: str
    source: FloatArray
    target: FloatArray
    truth: FloatArray | None = None


def pairs(data: Path) -> Iterator[Pair]:
    yield Pair("ETH apartment", *(read_cloud(data / TUTORIAL / f"cloud_{k}.vtk") for k in (1, 0)))
    lidar = data / "cloud_small_gicp/data"
    truth = np.loadtxt(lidar / "T_target_source.txt")
    yield Pair("vehicle lidar", read_cloud(lidar / "source.ply"), read_cloud(lidar / "target.ply"), truth)
    captures = [read_cloud(data / f"cloud_pcl_pairwise/pairwise/capture000{k}.pcd") for k in range(1, 6)]
    for k, (target, source) in enumerate(pairwise(captures), start=1):
        yield Pair(f"PCL {k + 1} to {k}", source, target)
    poses = transform_from_pose7(np.loadtxt(data / RGBD / "pose.txt"))
    views = [depth_points(data / RGBD / "depth" / f"{k}.pgm") for k in range(1, 6)]
    for a, b in pairwise(range(5)):
        yield Pair(f"slambook {b + 1} to {a + 1}", views[b], views[a], invert_transform(poses[a]) @ poses[b])


def depth_points(path: Path) -> FloatArray:
    """Points (n, 3) m in the optical frame of a depth image in mm."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    z = image[::STRIDE, ::STRIDE].astype(np.float64) / 1000.0
    v, u = np.mgrid[0 : image.shape[0] : STRIDE, 0 : image.shape[1] : STRIDE]
    points = np.stack([(u - CX) / FX * z, (v - CY) / FY * z, z], axis=-1)
    return points[z > 0.0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    for pair in pairs(arguments.data):
        report(pair, None)
        if pair.truth is not None:
            report(pair, rigid(pair.truth))


def report(pair: Pair, guess: FloatArray | None) -> None:
    began = time.perf_counter()
    result = register(pair.source, pair.target, guess)
    took, T = 1e3 * (time.perf_counter() - began), result.T_target_source
    print(
        f"{pair.name if guess is None else '   from the truth':16s} {'converged' if result.converged else 'failed':10s}"
        f"t {np.round(T[:3, 3], 3)} m, {degrees(so3_log(T[:3, :3])):.2f} deg, overlap {result.overlap:.2f}, "
        f"{took:.0f} ms"
    )
    if pair.truth is not None:
        d = boxminus(T, rigid(pair.truth))
        print(f"{'':16s} {1e3 * np.linalg.norm(d[:3]):.1f} mm and {degrees(d[3:]):.2f} deg from the truth")
    if result.reason:
        print(f"{'':16s} {result.reason}")


def degrees(rotation: FloatArray) -> float:
    return float(np.rad2deg(np.linalg.norm(rotation)))


def rigid(T: FloatArray) -> FloatArray:
    """The transform with the nearest rotation: files round."""
    left, _, right = np.linalg.svd(T[:3, :3])
    return make_transform(left @ right, T[:3, 3])


if __name__ == "__main__":
    main()
