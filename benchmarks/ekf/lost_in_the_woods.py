"""EKF-SLAM in 2D on Lost in the Woods (Barfoot, UTIAS): a wheeled robot among 17 tubes, 12 609 steps at 10 Hz.

Prints the RMSE of pose and landmarks against motion capture, for known and unknown association, beside dead reckoning.
The wheels' motion is 4.5 degrees off the laser's axis, a systematic error that white noise does not cover: the filter's
measurement noise is twice the published one, and NEES is still far above one.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io

from ekf_slam_node.planar import PlanarConfig, PlanarEkf, move, turn, wrap

DATA = Path(os.environ.get("INDOOR_SLAM_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


@dataclass(frozen=True, eq=False)
class Woods:
    """``motions`` (n, 3) m, m, rad; ranges, bearings (n, 17), range 0 where unseen; truth (n, 3), tubes (17, 2)."""

    motions: np.ndarray
    ranges: np.ndarray
    bearings: np.ndarray
    truth: np.ndarray
    tubes: np.ndarray
    motion_covariance: np.ndarray
    sigma_range: float
    sigma_bearing: float


def load(path: Path) -> Woods:
    """The data set; poses are those of the laser, which is ``d`` ahead of the wheels' axis."""
    data = scipy.io.loadmat(path)
    dt, d = 0.1, float(data["d"][0, 0])
    wheels = np.column_stack([data["x_true"], data["y_true"], data["th_true"]])
    truth = wheels.copy()
    truth[:, :2] += d * np.column_stack([np.cos(wheels[:, 2]), np.sin(wheels[:, 2])])
    v, om = data["v"].ravel(), data["om"].ravel()
    # The rate published with a step is the one measured before it.
    motions = np.array([_laser_motion(v[k - 1] * dt, om[k - 1] * dt, d) for k in range(len(v))])
    G = np.array([[dt, 0.0], [0.0, d * dt], [0.0, dt]])
    noise = G @ np.diag([data["v_var"][0, 0], data["om_var"][0, 0]]) @ G.T + 1e-12 * np.eye(3)
    sigmas = np.sqrt([data["r_var"][0, 0], data["b_var"][0, 0]])
    return Woods(motions, data["r"], data["b"], truth, data["l"], noise, float(sigmas[0]), float(sigmas[1]))


def _laser_motion(forward: float, angle: float, d: float) -> np.ndarray:
    """Motion of the laser for one of the axis, in the laser's frame."""
    step = turn(0.5 * angle) @ [forward, 0.0] + turn(angle) @ [d, 0.0] - [d, 0.0]
    return np.array([*step, angle])


def dead_reckoning(woods: Woods) -> np.ndarray:
    """Poses (n, 3) from the wheels alone."""
    poses = [woods.truth[0]]
    for motion in woods.motions[1:]:
        poses.append(move(poses[-1], motion)[0])
    return np.array(poses)


def run(woods: Woods, config: PlanarConfig, known: bool) -> tuple[np.ndarray, PlanarEkf, np.ndarray, float]:
    """Poses (n, 3), the filter at the end, NEES (n,) of the poses, share of wrong associations."""
    ekf = PlanarEkf(config, woods.truth[0], np.diag([1e-6, 1e-6, 1e-6]))
    poses, nees, wrong, total = [], [], 0, 0
    owner: dict[int, int] = {}
    for k, motion in enumerate(woods.motions):
        if k:
            ekf.predict(motion, woods.motion_covariance)
        ids = np.flatnonzero(woods.ranges[k] > 0.0)
        z = np.column_stack([woods.ranges[k, ids], woods.bearings[k, ids]])
        if len(ids):
            _, slots = ekf.process(z, ids if known else None)
            for slot, tube in zip(slots, ids, strict=True):
                if slot >= 0:
                    total += 1
                    wrong += owner.setdefault(int(slot), int(tube)) != tube
        error = woods.truth[k] - ekf.pose
        error[2] = wrap(error[2])
        nees.append(error @ np.linalg.solve(ekf.covariance.head(3)[:3], error))
        poses.append(ekf.pose.copy())
    return np.array(poses), ekf, np.array(nees), wrong / max(total, 1)


def landmark_rmse(woods: Woods, ekf: PlanarEkf) -> float:
    """Distance (m) of the landmarks from the nearest true tubes."""
    distance = np.linalg.norm(ekf.landmarks[:, None] - woods.tubes[None], axis=2).min(axis=1)
    return float(np.sqrt(np.mean(distance**2)))


def main() -> None:
    woods = load(DATA / "utias_aer1513" / "dataset2.mat")
    print(f"{'filter':36} {'pose m':>7} {'deg':>6} {'tubes':>6} {'RMSE m':>7} {'NEES/3':>7} {'wrong':>7} {'s':>6}")
    reckoned = dead_reckoning(woods)
    print(f"{'dead reckoning':36} {_rmse(woods, reckoned):7.3f} {_heading_deg(woods, reckoned):6.2f}")
    for method in ("known", "mahalanobis", "jcbb"):
        report(method, woods, method, "invariant")
    report("known, standard error", woods, "known", "standard")


def report(name: str, woods: Woods, method: str, error: str) -> None:
    known = method == "known"
    config = PlanarConfig(
        sigma_range=2.0 * woods.sigma_range, sigma_bearing=2.0 * woods.sigma_bearing, error=error,
        method="jcbb" if known else method,
    )  # fmt: skip
    start = time.perf_counter()
    poses, ekf, nees, wrong = run(woods, config, known)
    print(
        f"{name:36} {_rmse(woods, poses):7.3f} {_heading_deg(woods, poses):6.2f} {len(ekf.landmarks):6d} "
        f"{landmark_rmse(woods, ekf):7.3f} {np.mean(nees) / 3:7.2f} {wrong:7.2%} {time.perf_counter() - start:6.1f}",
        flush=True,
    )


def _rmse(woods: Woods, poses: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((poses - woods.truth)[:, :2] ** 2, axis=1))))


def _heading_deg(woods: Woods, poses: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(wrap(poses[:, 2] - woods.truth[:, 2]) ** 2))))


if __name__ == "__main__":
    main()
