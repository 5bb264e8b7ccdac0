# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM on real stereo tracks with known association: KITTI raw drives tracked by KLT (Clement et al. 2015).

    python benchmarks/ekf/stereo_tracks.py [DRIVES]

Every track gets a descriptor of its own, which makes its association known; tracks still drift and slip, so the gates
stay. Prints the drift of the chained submaps, without any loop closure, and the worst frame-to-frame error.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.results import TrackingState
from ekf_slam_node.slam import EkfSlam
from slam_core.camera import Camera
from slam_core.config import from_mapping
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_exp
from slam_core.types import Features

DATA = Path(os.environ.get("INDOOR_SLAM_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
SIGMA_PX = 0.5
SIGMA_DISPARITY = 0.5


@dataclass(frozen=True, eq=False)
class Drive:
    """``tracks`` (4, n, m): ul vl ur vr px, negative where unseen; ``truth`` (n, 4, 4) of the vehicle; its camera."""

    stamps_ns: np.ndarray
    tracks: np.ndarray
    truth: FloatArray
    T_vehicle_optical: FloatArray
    camera: Camera
    baseline: float


def load(path: Path) -> Drive:
    data = scipy.io.loadmat(path)
    frames = data["y_k_j"].shape[1]
    t = data["t"].ravel()[:frames]
    T_vehicle_optical = make_transform(data["C_c_v"].T, data["rho_v_c_v"].ravel())
    truth = make_transform(so3_exp(data["theta_vk_i"].T[:frames]), data["r_i_vk_i"].T[:frames])
    f, cu, cv = float(data["fu"][0, 0]), float(data["cu"][0, 0]), float(data["cv"][0, 0])
    camera = Camera(int(2 * cu), int(2 * cv), f, float(data["fv"][0, 0]), cu, cv)
    stamps = np.round((t - t[0]) * 1e9).astype(np.int64)
    return Drive(stamps, data["y_k_j"], truth, T_vehicle_optical, camera, float(data["b"][0, 0]))


def features(drive: Drive, k: int, descriptors: np.ndarray) -> Features:
    ul, vl, ur, _ = drive.tracks[:, k]
    index = np.flatnonzero((ul > 0) & (ur > 0) & (ul - ur > 1.0))
    n, fb = len(index), drive.camera.fx * drive.baseline
    depth = fb / (ul - ur)[index]
    uv = np.column_stack([ul, vl])[index]
    f32 = np.float32
    return Features(
        int(drive.stamps_ns[k]), drive.camera.unproject(uv, depth).astype(f32), uv.astype(f32), depth.astype(f32),
        np.full((n, 2), SIGMA_PX, dtype=f32), (depth**2 / fb * SIGMA_DISPARITY).astype(f32), np.ones(n, dtype=f32),
        np.zeros(n, dtype=np.uint8), descriptors[index], drive.camera,
    )  # fmt: skip


def run(drive: Drive) -> tuple[FloatArray, int, int, float]:
    """Poses (n, 4, 4), submaps, lost frames, median milliseconds per frame."""
    rng = np.random.default_rng(0)
    descriptors = rng.standard_normal((drive.tracks.shape[2], 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    config = from_mapping(EkfSlamConfig, {"submap.max_distance": 5.0, "motion.sigma_initial_velocity": 15.0})
    slam = EkfSlam(config, drive.T_vehicle_optical)
    poses, submaps, lost, times = [], 0, 0, []
    for k in range(len(drive.stamps_ns)):
        frame = features(drive, k, descriptors)
        start = time.perf_counter()
        result = slam.process(frame)
        times.append(time.perf_counter() - start)
        poses.append(result.pose.T)
        submaps += len(result.submaps)
        lost += result.state is TrackingState.LOST
    return np.array(poses), submaps + len(slam.finish()), lost, 1e3 * float(np.median(times))


def main() -> None:
    paths = sorted((DATA / "stereo_tracks_msckf").rglob("*_KLT.mat"))[: int(sys.argv[1]) if len(sys.argv) > 1 else 3]
    print(f"{'drive':32}{'frames':>8}{'path m':>8}{'end m':>8}{'end %':>7}{'deg':>7}{'submaps':>9}{'lost':>6}{'ms':>7}")
    for path in paths:
        drive = load(path)
        poses, submaps, lost, took = run(drive)
        error = boxminus(invert_transform(drive.truth[0]) @ drive.truth[-1], poses[-1])
        length = float(np.linalg.norm(np.diff(drive.truth[:, :3, 3], axis=0), axis=1).sum())
        end = float(np.linalg.norm(error[:3]))
        print(
            f"{path.stem:32}{len(poses):8d}{length:8.1f}{end:8.2f}{100 * end / length:7.2f}"
            f"{np.degrees(np.linalg.norm(error[3:])):7.2f}{submaps:9d}{lost:6d}{took:7.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
