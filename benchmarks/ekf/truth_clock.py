# SPDX-License-Identifier: Apache-2.0
"""Scale, or the ground truth's clock and lever arm? Errors of trajectories explained by what may be wrong in the truth.

    python benchmarks/ekf/truth_clock.py BAG [--orbslam3 PYTHON]

BAG: stereo with ground truth. Our joined map, SIFT and PnP from frame to frame and, where it is installed, ORB-SLAM3
are laid on the truth by least squares with, one after the other, a scale, a delay of the truth's positions, and a lever
arm by which the truth's point is off. What all programs ask for alike is the truth's. The last line asks the IMU, which
knows no camera: positions over windows of a second are integrated from the accelerometer with the truth's rotations,
each window with a start and a velocity of its own, all with one bias, one gravity and one lever arm. One sigma of
independent residuals; the accelerometer's counts 20 samples as one.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from slam_bags.reading.readings import ImuReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import align
from slam_core.geometry import FloatArray, make_transform, so3_exp, so3_log
from slam_core.trajectory import Trajectory
from slam_experiments.benchmark.orbslam3 import is_there, orbslam3
from slam_experiments.benchmark.visual_odometry import frame_to_frame

_MARGIN_S, _WINDOW_S, _STEP_S, _CORRELATED = 0.05, 1.0, 0.005, 20
_SHIFTS_S = np.arange(-0.02, 0.0201, 0.0025)
_FITS = {
    "nothing": (), "scale": (6,), "delay": (7,), "lever arm": (8, 9, 10), "delay, lever arm": (7, 8, 9, 10),
    "all three": (6, 7, 8, 9, 10),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Truth:
    """Poses of the point whose position was measured (the IMU where there is one), s from ``start_ns``."""

    start_ns: int
    times: FloatArray
    poses: FloatArray
    T_base_point: FloatArray

    def rotations(self, t: FloatArray) -> FloatArray:
        """R (n, 3, 3) at times (n,) s."""
        return np.asarray(Slerp(self.times, Rotation.from_matrix(self.poses[:, :3, :3]))(t).as_matrix())

    def positions(self, t: FloatArray) -> FloatArray:
        """Positions (n, 3) m at times (n,) s."""
        return np.column_stack([np.interp(t, self.times, self.poses[:, k, 3]) for k in range(3)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--orbslam3", default=sys.executable, help="interpreter that has orbslam3-python")
    arguments = parser.parse_args()
    truth, imu = read(arguments.bag)
    table = Table("program", "free", "ATE mm", "scale %", "delay ms", "lever arm mm", title=arguments.bag.name)
    for name, trajectory in programs(arguments.bag, arguments.orbslam3):
        for fit, free in _FITS.items():
            table.add_row(name, fit, *fitted(trajectory, truth, free))
    if len(imu):
        table.add_row("accelerometer", "delay, lever arm", *by_accelerometer(imu, truth))
    Console(width=120).print(table)


def read(path: Path) -> tuple[Truth, FloatArray]:
    """The truth, and IMU samples (n, 4): s, accelerations in the IMU's axes."""
    with SensorBag(path) as bag:
        agent = bag.agents[0]
        found, sensors = bag.ground_truth(agent), bag.sensors[agent]
        samples = [reading.sample for reading in bag.readings() if isinstance(reading, ImuReading)]
    if found is None:
        raise SystemExit(f"{path} has no ground truth")
    T = sensors.frames.lookup(sensors.base_frame, samples[0].frame_id) if samples else np.eye(4)
    start = int(found.stamps_ns[0])
    times = 1e-9 * (found.stamps_ns - start)
    imu = np.array([[1e-9 * (s.stamp_ns - start), *s.linear_acceleration] for s in samples]).reshape(-1, 4)
    return Truth(start, times, found.poses @ T, T), imu


def programs(bag: Path, python: str) -> list[tuple[str, Trajectory]]:
    system = choose(load_system_config(None, bag), "stereo", "sjsam", "none", "off")
    system = replace(system, dense_mapper=replace(system.dense_mapper, use_stereo=False, use_tof=False))
    found = [("ours", run_bag(bag, system)[0].agents[0].trajectory), ("SIFT + PnP", frame_to_frame(bag, "stereo")[0])]
    if is_there(python):
        with tempfile.TemporaryDirectory() as folder:
            found.append(("ORB-SLAM3", orbslam3(bag, "stereo", "stereo", python, Path(folder))[0]))
    return found


def fitted(trajectory: Trajectory, truth: Truth, free: tuple[int, ...]) -> list[str]:
    """ATE, and scale, delay and lever arm as far as they are free, of a trajectory of the base."""
    t = 1e-9 * (trajectory.stamps_ns - truth.start_ns)
    inside = (t > _MARGIN_S) & (t < truth.times[-1] - _MARGIN_S)
    t, poses = t[inside], (trajectory.poses @ truth.T_base_point)[inside]
    turned, wanted = truth.rotations(t), (0, 1, 2, 3, 4, 5, *free)
    true = np.array([make_transform(R, p) for R, p in zip(turned, truth.positions(t), strict=True)])
    laid = align(poses, true, "se3")[0]
    start = np.zeros(11)
    start[:3] = so3_log(laid[:3, :3] @ poses[0, :3, :3].T)
    start[3:6] = laid[:3, 3] - so3_exp(start[:3]) @ poses[0, :3, 3]

    def residual(values: FloatArray) -> FloatArray:
        x = start.copy()
        x[list(wanted)] = values
        laid_on = poses[:, :3, 3] @ so3_exp(x[:3]).T / (1.0 + x[6]) + x[3:6]
        return (laid_on + turned @ x[8:11] - truth.positions(t + x[7])).ravel()

    r = least_squares(residual, start[list(wanted)], x_scale="jac")
    covariance = np.linalg.inv(r.jac.T @ r.jac) * (r.fun @ r.fun) / (len(r.fun) - len(wanted))
    value, sigma = (dict(zip(wanted, v, strict=True)) for v in (r.x, np.sqrt(np.diag(covariance))))
    texts = [_text([u * value[k] for k in keys if k in value], [u * sigma[k] for k in keys if k in value])
             for u, keys in ((1e2, (6,)), (1e3, (7,)), (1e3, (8, 9, 10)))]  # fmt: skip
    return [f"{1e3 * np.sqrt(np.mean(np.sum(r.fun.reshape(-1, 3) ** 2, axis=1))):.2f}", *texts]


def by_accelerometer(imu: FloatArray, truth: Truth) -> list[str]:
    """The delay with the least residual, and the lever arm there."""
    fits = [_integrated(imu, truth, shift) for shift in _SHIFTS_S]
    best = int(np.argmin([rms for rms, _, _ in fits]))
    rms, lever, sigma = fits[best]
    return [f"{1e3 * rms:.2f}", "", f"{1e3 * _SHIFTS_S[best]:+.1f}", _text(1e3 * lever, 1e3 * sigma)]


def _integrated(imu: FloatArray, truth: Truth, shift: float) -> tuple[float, FloatArray, FloatArray]:
    end = min(imu[-1, 0], truth.times[-1])
    starts = np.arange(0.2, end - _WINDOW_S - 0.2, _WINDOW_S)
    blocks, sides = [], []
    for k, begin in enumerate(starts):
        t = np.arange(begin, begin + _WINDOW_S, _STEP_S)
        R = truth.rotations(t)
        acceleration = np.column_stack([np.interp(t, imu[:, 0], imu[:, i]) for i in (1, 2, 3)])
        # p = p0 + v0 t + twice integrated R (a - bias) + g t^2 / 2 + R lever
        block = np.zeros((len(t), 3, 9 + 6 * len(starts)))
        since = (t - begin)[:, None, None]
        block[:, :, 0:3], block[:, :, 3:6], block[:, :, 6:9] = -_twice(R), 0.5 * since**2 * np.eye(3), R
        block[:, :, 9 + 6 * k : 12 + 6 * k], block[:, :, 12 + 6 * k : 15 + 6 * k] = np.eye(3), since * np.eye(3)
        blocks.append(block.reshape(3 * len(t), -1))
        sides.append((truth.positions(t + shift) - _twice(np.einsum("nij,nj->ni", R, acceleration))).ravel())
    A, b = np.vstack(blocks), np.concatenate(sides)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    e = b - A @ x
    sigma = np.sqrt(np.diag(np.linalg.pinv(A.T @ A))[6:9] * (e @ e) / len(e) * _CORRELATED)
    return float(np.sqrt(np.mean(np.sum(e.reshape(-1, 3) ** 2, axis=1)))), x[6:9], sigma


def _twice(values: FloatArray) -> FloatArray:
    """Integrated twice over time by trapezia."""
    for _ in range(2):
        steps = 0.5 * _STEP_S * (values[1:] + values[:-1])
        values = np.concatenate([np.zeros_like(values[:1]), np.cumsum(steps, axis=0)])
    return values


def _text(values: FloatArray | list[float], sigmas: FloatArray | list[float]) -> str:
    digits = 2 if len(values) == 1 else 0
    return ", ".join(f"{v:+.{digits}f} +- {s:.{digits}f}" for v, s in zip(values, sigmas, strict=True))


if __name__ == "__main__":
    main()
