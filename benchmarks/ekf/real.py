# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM on real images with ground truth: KITTI (51 pairs, 10 Hz) and EuRoC V1_01 (50 key frames, about 1 s apart).

    python benchmarks/ekf/real.py [kitti] [euroc]

Chained submaps alone, no loop closure. A gap is bridged if the frame after it is linked to the map of the frame before.
ANEES up to the first lost frame: as it is, with the error of the ground truth itself, and with that of the calibration
too (``slam_experiments.benchmark.truth``). KITTI a second time without its first ten pairs: ``ground_truth.py`` shows
why.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import yaml

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from slam_core.evaluation import EXACT_TRUTH, TruthAccuracy, pose_nees
from slam_core.geometry import (
    OPTICAL_FROM_RIG,
    FloatArray,
    boxminus,
    interpolate_transform,
    invert_transform,
    make_transform,
    transform_from_pose7,
)
from slam_core.trajectory import Trajectory
from slam_core.types import StereoImages
from slam_experiments.benchmark.truth import TRUTH, with_calibration_error
from stereo_frontend.frontend import Frontend

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "features"))
from datasets import DATA, euroc_infos, euroc_pairs, kitti_pairs

T_OPTICAL_RIG = make_transform(OPTICAL_FROM_RIG, np.zeros(3))


def kitti() -> tuple[list[StereoImages], FloatArray]:
    """Pairs and true rig poses (n, 4, 4)."""
    rows = np.loadtxt(DATA / "kitti_stereo_51x2" / "KITTI_sequence_1" / "poses.txt").reshape(-1, 3, 4)
    poses = make_transform(rows[:, :, :3], rows[:, :, 3])
    return list(kitti_pairs()), invert_transform(T_OPTICAL_RIG) @ poses @ T_OPTICAL_RIG


def euroc() -> tuple[list[StereoImages], FloatArray]:
    """Pairs and true rig poses (n, 4, 4), from the body's by the camera's mounting and rectification."""
    path = DATA / "euroc_v101_micro95" / "MicroEurocDataset" / "mav0" / "cam0" / "sensor.yaml"
    sensor = yaml.safe_load(path.read_text().replace("%YAML:1.0", ""))
    T_body_raw = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    T_body_rig = T_body_raw @ make_transform(np.asarray(euroc_infos()[0].R).T, np.zeros(3)) @ T_OPTICAL_RIG
    truth = np.loadtxt(DATA / "traj_gt_openvins" / "euroc_mav" / "V1_01_easy.txt")
    pairs = list(euroc_pairs())
    return pairs, np.array([_at(truth, pair.stamp_ns * 1e-9) for pair in pairs]) @ T_body_rig


def _at(truth: FloatArray, stamp: float) -> FloatArray:
    k = int(np.clip(np.searchsorted(truth[:, 0], stamp), 1, len(truth) - 1))
    share = (stamp - truth[k - 1, 0]) / (truth[k, 0] - truth[k - 1, 0])
    before, after = transform_from_pose7(truth[k - 1, 1:]), transform_from_pose7(truth[k, 1:])
    return interpolate_transform(before, after, np.array(np.clip(share, 0.0, 1.0)))


def run(pairs: list[StereoImages]) -> tuple[list[EkfResult], list[float], float]:
    """Results, milliseconds of the filter per frame, median milliseconds of the front end."""
    frontend, slam, results, filter_ms, eyes_ms = Frontend(), EkfSlam(EkfSlamConfig()), [], [], []
    for pair in pairs:
        start = time.perf_counter()
        features = frontend.process(pair)
        seen = time.perf_counter()
        results.append(slam.process(features))
        eyes_ms.append(1e3 * (seen - start))
        filter_ms.append(1e3 * (time.perf_counter() - seen))
    return results, filter_ms, float(np.median(eyes_ms))


def report(name: str, pairs: list[StereoImages], truth: FloatArray) -> None:
    results, filter_ms, eyes_ms = run(pairs)
    poses = np.array([result.pose.T for result in results])
    lost = [k for k, result in enumerate(results) if result.state is TrackingState.LOST]
    steps = boxminus(invert_transform(truth[:-1]) @ truth[1:], invert_transform(poses[:-1]) @ poses[1:])
    linked = np.setdiff1d(np.arange(len(steps)), np.array(lost, dtype=int) - 1)
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    end = boxminus(invert_transform(truth[0]) @ truth[-1], invert_transform(poses[0]) @ poses[-1])
    submaps = sum(len(result.submaps) for result in results) + 1
    print(f"{name}: {len(pairs)} frames, path {length:.1f} m, {submaps} submaps, frames lost: {lost or 'none'}")
    shift = 1e3 * np.linalg.norm(steps[linked, :3], axis=1)
    turn = np.degrees(np.linalg.norm(steps[linked, 3:], axis=1))
    print(
        f"  bridged {len(linked)} of {len(steps)} gaps, error of a step: median {np.median(shift):.1f} mm, "
        f"{np.median(turn):.3f} deg, worst {shift.max():.1f} mm, {turn.max():.2f} deg"
    )
    if not lost:
        print(f"  end error {np.linalg.norm(end[:3]):.2f} m = {100 * np.linalg.norm(end[:3]) / length:.2f} %")
    known = lost[0] if lost else len(results)
    trajectory = Trajectory.from_estimates([result.pose for result in results[:known]])
    cases = ((trajectory, EXACT_TRUTH), (trajectory, TRUTH[name]), (with_calibration_error(trajectory), TRUTH[name]))
    exact, with_truth, with_both = (anees(poses, truth[:known], accuracy) for poses, accuracy in cases)
    print(
        f"  ANEES of the first {known} poses {exact:.1f}, with the truth's own error {with_truth:.1f}, "
        f"and the calibration's {with_both:.1f}"
    )
    nis = np.array([result.nis / result.nis_dof for result in results if result.nis_dof])
    times = f"{np.median(filter_ms):.1f} ms (95 %: {np.percentile(filter_ms, 95):.1f})"
    print(f"  NIS/dof {np.median(nis):.2f}, filter {times}, front end {eyes_ms:.1f} ms", flush=True)


def anees(poses: Trajectory, truth: FloatArray, accuracy: TruthAccuracy) -> float:
    """Mean NEES per degree of freedom."""
    return float(np.mean(pose_nees(poses, truth, accuracy))) / 6.0


def main() -> None:
    for name in sys.argv[1:] or ("kitti", "euroc"):
        pairs, truth = {"kitti": kitti, "euroc": euroc}[name]()
        report(name, pairs, truth)
        if name == "kitti":
            print("without the first ten pairs, ", end="")
            report(name, pairs[10:], truth[10:])


if __name__ == "__main__":
    main()
