"""Does the calibration recover simulated rigs within its own standard deviations?

    python benchmarks/calibration/montecarlo.py [--trials 12]

Each trial draws 20 views of a board with corner noise of 0.15 px per axis and calibrates the rig. Of the normalised
errors (estimate - truth) / own sigma of all parameters, the table shows the standard deviation (1 if sigma is honest)
and the share within 3 sigma (99.7 % of a normal distribution), and the seconds per calibration.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from slam_calibration.board import Chessboard
from slam_calibration.bundle import BundleResult, LensState
from slam_calibration.rig import calibrate
from slam_calibration.simulated import beside, example_camera, random_view, simulate_views
from slam_core.geometry import FloatArray, boxminus

BOARD = Chessboard(9, 7, 0.04).points
RIGS: dict[str, list[LensState]] = {
    "stereo, plumb_bob": [
        example_camera("plumb_bob"),
        example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0))),
    ],
    "stereo-tof": [example_camera("none"), example_camera("plumb_bob4", beside(0.0, 0.09, (0.005, -0.007, 0.003)))],
    "fisheye pair": [example_camera("equidistant"), example_camera("equidistant", beside(0.06, 0.0, (0, 0.03, 0)))],
    "mono, rational": [example_camera("rational_polynomial")],
}


def normalised_errors(result: BundleResult, truth: list[LensState]) -> FloatArray:
    errors = [s.parameters - t.parameters for s, t in zip(result.rig.cameras, truth, strict=True)]
    errors += [boxminus(s.T, t.T) for s, t in zip(result.rig.cameras[1:], truth[1:], strict=True)]
    return np.asarray(np.concatenate(errors) / np.sqrt(np.diag(result.covariance)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=12)
    trials = parser.parse_args().trials
    print(f"{'rig':20s} {'parameters':>10s} {'std':>6s} {'< 3 sigma':>10s} {'s':>6s}")
    for name, truth in RIGS.items():
        errors, start = [], time.perf_counter()
        for trial in range(trials):
            rng = np.random.default_rng([trial, 5])
            views = simulate_views(rng, BOARD, truth, [random_view(rng) for _ in range(20)], 0.15)
            sizes = [(state.width, state.height) for state in truth]
            errors.append(normalised_errors(calibrate(BOARD, views, sizes, [s.lens for s in truth]), truth))
        q = np.concatenate(errors)
        seconds = (time.perf_counter() - start) / trials
        print(f"{name:20s} {len(q):10d} {np.std(q):6.2f} {np.mean(np.abs(q) < 3.0):10.1%} {seconds:6.2f}")


if __name__ == "__main__":
    main()
