# SPDX-License-Identifier: Apache-2.0
"""Who errs, the filter or the ground truth? KITTI's and EuRoC's truth against two estimates that share no code.

    python benchmarks/ekf/ground_truth.py [kitti] [euroc]

The one is the filter; the other knows neither our features nor a map: OpenCV's SIFT, matched between the images of a
pair and from frame to frame, and PnP with RANSAC on the points that the earlier pair triangulates. Where both differ
from the truth by the same rotation and agree with each other, the truth is off, or the calibration that both share; a
wrong calibration errs in proportion to the motion, over the whole run. If the three err independently, their three
differences give the error of each (the three-cornered hat, Gray and Allan 1974): what falls to the truth includes the
calibration.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from real import T_OPTICAL_RIG, euroc, kitti, run

from slam_core.geometry import FloatArray, invert_transform, make_transform, so3_log
from slam_core.types import StereoImages
from slam_experiments.benchmark.visual_odometry import matches, stereo_points

_LEAST_INLIERS = 30


def steps_by_pnp(pairs: list[StereoImages]) -> FloatArray:
    """Motions T_previous_now (n - 1, 4, 4) of the left optical frame; NaN where too little agrees."""
    steps, K = np.full((len(pairs) - 1, 4, 4), np.nan), pairs[0].stereo.camera.K
    _, described, points = stereo_points(pairs[0])
    for k, pair in enumerate(pairs[1:]):
        now = stereo_points(pair)
        index = matches(described, now[1])
        seen, pixels = points[index[:, 0]], now[0][index[:, 1]]
        found, turn, shift, inliers = cv2.solvePnPRansac(seen, pixels, K, None, None, None, False, 1000, 1.5, 0.999)
        if found and len(inliers) >= _LEAST_INLIERS:
            chosen = inliers.ravel()
            turn, shift = cv2.solvePnPRefineLM(seen[chosen], pixels[chosen], K, None, turn, shift)
            rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
            steps[k] = invert_transform(make_transform(rotation, np.asarray(shift, np.float64).ravel()))
        _, described, points = now
    return steps


def turns(T: FloatArray, reference: FloatArray) -> FloatArray:
    """Rotations (n, 3) mrad between two sets of motions (n, 4, 4)."""
    return np.asarray(1e3 * so3_log(np.swapaxes(reference[:, :3, :3], 1, 2) @ T[:, :3, :3]))


def report(name: str, pairs: list[StereoImages], truth: FloatArray) -> None:
    """How far the steps differ in rotation, and what the first ten and the others add up to."""
    filtered = np.array([result.pose.T for result in run(pairs)[0]])
    optical = [poses @ invert_transform(T_OPTICAL_RIG) for poses in (truth, filtered)]
    true, ours = (invert_transform(poses[:-1]) @ poses[1:] for poses in optical)
    theirs = steps_by_pnp(pairs)
    known = np.isfinite(theirs[:, 0, 0])
    print(f"{name}: {known.sum()} of {len(known)} steps by SIFT and PnP")
    squares = []
    for label, a, b in (("filter - truth", ours, true), ("PnP - truth", theirs, true), ("filter - PnP", ours, theirs)):
        d = turns(a[known], b[known])
        squares.append(np.median(np.sum(d**2, axis=1)))
        print(
            f"  {label:15} median turn {np.sqrt(squares[-1]):5.2f} mrad a step; sum over the first ten "
            f"{_text(d[:10].sum(axis=0))}, over the others {_text(d[10:].sum(axis=0))} mrad"
        )
    each = np.sqrt(np.maximum(0.5 * sum(squares) - np.array(squares)[[1, 2, 0]], 0.0))
    print("  on its own, mrad a step: filter {:.2f}, truth {:.2f}, PnP {:.2f}".format(*each), flush=True)


def _text(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{value:5.1f}" for value in vector) + ")"


def main() -> None:
    for name in sys.argv[1:] or ("kitti", "euroc"):
        report(name, *{"kitti": kitti, "euroc": euroc}[name]())


if __name__ == "__main__":
    main()
