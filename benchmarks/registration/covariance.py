"""NEES of many noisy registrations per motion: a mean of 6 is exact, far above 6 is a promise not kept.

Noise and place stand for its two parts by the mean covariance: what differs from scan to scan, and what is the same in
all of them, because the two views of one place show things from other sides.
"""

from __future__ import annotations

import argparse

import numpy as np
from grid import ROOM
from scans import THESIS_MOTIONS, TofRoom, rig_motion, rig_pose, thinned
from scipy.stats import chi2

from ndt_registration.registration import register
from slam_core.geometry import boxminus

MOTIONS = ("forward 25 cm", "sideways 25 cm", "(25, 25) cm", "yaw +10 deg")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--scenario", default=str(ROOM))
    arguments = parser.parse_args()
    room, rng, start = TofRoom(arguments.scenario), np.random.default_rng(2), rig_pose(0.7, 1.9)
    runs = arguments.runs
    low, high = (chi2.ppf(p, 6 * runs) / runs for p in (0.025, 0.975))
    print(f"{runs} runs; 95 % bounds of the mean {low:.2f} ... {high:.2f}")
    print("motion               mean   median  below 99 % gate  noise  place")
    for name in MOTIONS:
        truth, errors, covariances = room.motion(THESIS_MOTIONS[name]), [], []
        for _ in range(arguments.runs):
            source, target = (
                thinned(room.scan(T, rng), 0.2, rng) for T in (start @ rig_motion(THESIS_MOTIONS[name]), start)
            )
            result = register(source, target, truth)
            errors.append(boxminus(result.T_target_source, truth))
            covariances.append(result.covariance)
        nees = [d @ np.linalg.solve(P, d) for d, P in zip(errors, covariances, strict=True)]
        common, information = np.mean(errors, axis=0), np.linalg.inv(np.mean(covariances, axis=0))
        noise, place = np.trace(information @ np.cov(np.transpose(errors))), common @ information @ common
        inside = np.mean(np.array(nees) < chi2.ppf(0.99, 6))
        print(
            f"{name:20s} {np.mean(nees):6.2f} {np.median(nees):6.2f} {100 * inside:8.1f} % {noise:13.2f} {place:6.2f}"
        )


if __name__ == "__main__":
    main()
