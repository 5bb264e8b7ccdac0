# SPDX-License-Identifier: Apache-2.0
"""Section 2.4: calibration of the stereo camera, the laser camera and both together; Tables 2.1 to 2.3."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from slam_calibration.board import Chessboard
from slam_calibration.bundle import LensState
from slam_calibration.rig import calibrate
from slam_core.geometry import boxminus
from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import Job, JobResult, Kept
from slam_simulation.calibration.board_views import beside, example_camera, random_view, simulate_views

MODULE = "slam_experiments.experiments.calibration"
_BOARD = Chessboard(9, 7, 0.04).points
_CORNER_SIGMA_PX = 0.15
_VIEWS = 20
_STEREO, _LASER, _BOTH = "Bumblebee: stereo pair", "CamCube: laser camera alone", "stereo and laser camera"
_CLAIMS = {_STEREO: thesis.SPECIFIED, _LASER: thesis.CAMCUBE, _BOTH: thesis.EXTRINSICS}


def _rigs() -> dict[str, list[LensState]]:
    pair = [example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0)))]
    both = [example_camera("none"), example_camera("plumb_bob4", beside(0.0, 0.09, (0.005, -0.007, 0.003)))]
    return {
        _STEREO: pair,
        _LASER: [example_camera("plumb_bob4")],
        _BOTH: both,
    }


def monte_carlo(folder: Path, before: list[Path], rig: str, trials: int) -> Kept:
    """Errors of all parameters over their own standard deviations."""
    truth, errors = _rigs()[rig], []
    for trial in range(trials):
        rng = np.random.default_rng([trial, 5])
        views = simulate_views(rng, _BOARD, truth, [random_view(rng) for _ in range(_VIEWS)], _CORNER_SIGMA_PX)
        sizes = [(state.width, state.height) for state in truth]
        result = calibrate(_BOARD, views, sizes, [s.lens for s in truth])
        sigma = np.sqrt(np.diag(result.covariance))
        error = [s.parameters - t.parameters for s, t in zip(result.rig.cameras, truth, strict=True)]
        error += [boxminus(s.T, t.T) for s, t in zip(result.rig.cameras[1:], truth[1:], strict=True)]
        errors.append(np.concatenate(error) / sigma)
    return {"rig": rig}, {"normalised": np.array(errors)}


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        trials = 2 if quick else 20
        packages = ("slam_core", "slam_calibration")
        return {rig: Job(f"{MODULE}:monte_carlo", {"rig": rig, "trials": trials}, packages) for rig in _rigs()}

    def report(results: Mapping[str, JobResult]) -> Findings:
        comparisons, rows = [], []
        for rig, result in results.items():
            normalised = result.arrays["normalised"].ravel()
            inside = float(np.mean(np.abs(normalised) < 3.0))
            spread = float(np.std(normalised))
            comparisons.append(
                Comparison(
                    f"{rig}: errors within 3 sigma",
                    _CLAIMS[rig],
                    f"{100 * inside:.1f} %",
                    ">= 99 %",
                    inside >= 0.99,
                )
            )
            rows.append([rig, str(result.arrays["normalised"].shape[1]), f"{spread:.2f}", f"{100 * inside:.1f}"])
        table = Table(
            f"{_VIEWS} views, corner noise {_CORNER_SIGMA_PX} px: errors over their claimed sigma",
            ("Tables 2.1, 2.2, 2.3", "parameters", "standard deviation (1 is honest)", "within 3 sigma %"),
            rows,
        )
        return Findings(comparisons, [table], [Picture(_histogram(results), "", "Errors over claimed sigma.")])

    return Experiment("calibration", "2.4", "Calibration recovers what it claims", jobs, report)


def _histogram(results: Mapping[str, JobResult]) -> Figure:
    figure, axes = plots.new_figure(7, 3)
    bins = np.linspace(-4, 4, 33)
    for rig, result in results.items():
        axes.hist(result.arrays["normalised"].ravel(), bins.tolist(), density=True, histtype="step", label=rig)
    axes.plot(bins, norm.pdf(bins), "k--", linewidth=0.9, label="normal")
    axes.set(xlabel="error / sigma", ylabel="density")
    axes.legend(fontsize=8)
    return figure


EXPERIMENTS = (_experiment(),)
