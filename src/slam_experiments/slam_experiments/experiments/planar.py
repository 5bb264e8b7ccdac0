# SPDX-License-Identifier: Apache-2.0
"""Sections 1.7, 5.1 and 6.5: EKF-SLAM and SAM in the plane, with known and with unknown association."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import FloatArray
from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf, wrap
from slam_experiments.planar.sam import PlanarGraph, PlanarMap, cost, smooth
from slam_simulation.planar import PlanarRun, PlanarWorldConfig, simulate_planar

MODULE = "slam_experiments.experiments.planar"
_BEARINGS = (0.01, 0.03, 0.1)


def _case(sigma_bearing: float, known: bool, runs: int) -> Job:
    arguments = {"sigma_bearing": sigma_bearing, "known": known, "runs": runs}
    return Job(f"{MODULE}:monte_carlo", arguments, (*RENDERING, "ekf_slam_node"))


def monte_carlo(folder: Path, before: list[Path], sigma_bearing: float, known: bool, runs: int) -> Kept:
    """Errors, NEES and costs of filter and smoother over ``runs`` worlds, and the first world's maps."""
    rows = []
    arrays: dict[str, FloatArray] = {}
    for seed in range(runs):
        run = simulate_planar(PlanarWorldConfig(sigma_bearing=sigma_bearing), np.random.default_rng(seed))
        ekf, poses, slots = filter_run(run, known)
        graph = graph_of(run, slots)
        smoothed = smooth(graph, run.poses[0], ekf.config)[0]
        filtered = PlanarMap(poses, ekf.landmarks[np.unique(graph.landmark_index)])
        error = run.poses[-1] - poses[-1]
        error[2] = wrap(error[2])
        rows.append(
            [
                float(nees(error, ekf.covariance.head(3)[:3])) / 3.0,
                _rmse(poses, run),
                _rmse(smoothed.poses, run),
                cost(graph, filtered, ekf.config),
                cost(graph, smoothed, ekf.config),
                _wrong_share(run, slots),
                len(ekf.landmarks),
            ]
        )
        if seed == 0:
            arrays = {"truth": run.poses, "world": run.landmarks, "filter poses": poses, "filter map": ekf.landmarks,
                      "smoothed poses": smoothed.poses, "smoothed map": smoothed.landmarks,
                      **_before_closure(run, known)}  # fmt: skip
    names = ("nees", "filter rmse", "smoother rmse", "filter cost", "smoother cost", "wrong", "landmarks")
    return {"runs": runs}, arrays | {
        name: np.array(column) for name, column in zip(names, np.transpose(rows), strict=True)
    }


def filter_run(run: PlanarRun, known: bool) -> tuple[PlanarEkf, FloatArray, list[np.ndarray]]:
    """The filter over a drive: itself at the end, its poses (n, 3), the landmark slots of every step."""
    world = run.config
    config = PlanarConfig(sigma_range=world.sigma_range, sigma_bearing=world.sigma_bearing)
    ekf = PlanarEkf(config, run.poses[0], np.diag([1e-9, 1e-9, 1e-9]))
    Q = np.diag(np.array([world.sigma_step, world.sigma_step, world.sigma_turn]) ** 2)
    poses, slots = [], []
    for k, seen in enumerate(run.observations):
        if k:
            ekf.predict(run.odometry[k - 1], Q)
        _, used = ekf.process(np.column_stack([seen.ranges, seen.bearings]), seen.ids if known else None)
        poses.append(ekf.pose.copy())
        slots.append(used)
    return ekf, np.array(poses), slots


def graph_of(run: PlanarRun, slots: list[np.ndarray]) -> PlanarGraph:
    """The smoother's problem of a drive whose measurements were associated with ``slots``."""
    world = run.config
    Q = np.diag(np.array([world.sigma_step, world.sigma_step, world.sigma_turn]) ** 2)
    pose = np.concatenate([np.full(len(s), k) for k, s in enumerate(slots)])
    z = np.concatenate([np.column_stack([o.ranges, o.bearings]) for o in run.observations])
    slot = np.concatenate(slots)
    used = slot >= 0
    landmark = np.unique(slot[used], return_inverse=True)[1]
    return PlanarGraph(run.odometry, Q, pose[used].astype(np.int64), landmark.astype(np.int64), z[used])


def _before_closure(run: PlanarRun, known: bool) -> dict[str, FloatArray]:
    """The smoothed map just before the start is seen again (Fig. 6.5)."""
    first = set(run.observations[0].ids.tolist())
    half = len(run.poses) // 2
    again = next(
        (k for k in range(half, len(run.poses)) if first & set(run.observations[k].ids.tolist())), len(run.poses)
    )
    part = PlanarRun(run.config, run.poses[:again], run.landmarks, run.odometry[: again - 1], run.observations[:again])
    ekf, _, slots = filter_run(part, known)
    smoothed = smooth(graph_of(part, slots), part.poses[0], ekf.config)[0]
    return {"open poses": smoothed.poses, "open map": smoothed.landmarks}


def _rmse(poses: FloatArray, run: PlanarRun) -> float:
    return float(np.sqrt(np.mean(np.sum((poses - run.poses)[:, :2] ** 2, axis=1))))


def _wrong_share(run: PlanarRun, slots: list[np.ndarray]) -> float:
    """Share of the associated measurements whose landmark was made by another true one."""
    owner: dict[int, int] = {}
    wrong = total = 0
    for used, seen in zip(slots, run.observations, strict=True):
        for slot, true in zip(used.tolist(), seen.ids.tolist(), strict=True):
            if slot >= 0:
                total += 1
                wrong += owner.setdefault(slot, true) != true
    return wrong / max(total, 1)


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        runs = 5 if quick else 50
        return {
            f"{'known' if known else 'unknown'}, {s:g} rad": _case(s, known, runs)
            for known in (True, False)
            for s in _BEARINGS
        }

    return Experiment("planar", "1.7, 5.1, 6.5", "EKF-SLAM and SAM in the plane", jobs, _report)


def _report(results: Mapping[str, JobResult]) -> Findings:
    known = {name: r.arrays for name, r in results.items() if name.startswith("known")}
    runs = next(iter(results.values())).values["runs"]
    low, high = anees_bounds(3, runs, 0.99)
    comparisons = []
    for name, arrays in known.items():
        mean = float(arrays["nees"].mean())
        comparisons.append(
            Comparison(
                f"NEES of the last pose, {name}",
                thesis.ABSENT,
                f"{mean:.2f}",
                f"{low:.2f} to {high:.2f}",
                low <= mean <= high,
            )
        )
    below = all(np.all(r.arrays["smoother cost"] <= r.arrays["filter cost"] + 1e-9) for r in results.values())
    comparisons.append(
        Comparison(
            "SAM's cost below the filter's",
            thesis.SMOOTHS,
            "in every run" if below else "not in every run",
            "in every run",
            below,
        )
    )
    arrays = results[f"unknown, {_BEARINGS[0]:g} rad"].arrays
    return Findings(
        comparisons,
        [_table(runs, results)],
        [
            Picture(_drawn(arrays, "open"), "6.5", "SAM before the loop closes."),
            Picture(_drawn(arrays, "smoothed"), "6.6", "SAM after the loop closed."),
            Picture(_drawn(arrays, "filter"), "6.1", "The filter on the same drive."),
        ],
    )


def _table(runs: int, results: Mapping[str, JobResult]) -> Table:
    rows = [
        [
            name,
            f"{1e3 * a['filter rmse'].mean():.0f}",
            f"{1e3 * a['smoother rmse'].mean():.0f}",
            f"{a['nees'].mean():.2f}",
            f"{a['filter cost'].mean():.0f}",
            f"{a['smoother cost'].mean():.0f}",
            f"{100 * a['wrong'].mean():.2f}",
            f"{a['landmarks'].mean():.1f}",
        ]
        for name, a in ((name, r.arrays) for name, r in results.items())
    ]
    header = ("association, bearing noise", "EKF RMSE mm", "SAM RMSE mm", "EKF NEES", "EKF cost", "SAM cost",
              "wrong pairs %", "landmarks (40)")  # fmt: skip
    return Table(f"50 samples, {runs} worlds", header, rows)


def _drawn(arrays: Mapping[str, FloatArray], kind: str) -> Figure:
    figure, axes = plots.new_figure(6, 5)
    axes.plot(*arrays["world"].T, "o", mfc="none", color="0.4", markersize=5, label="true landmarks")
    axes.plot(*arrays[f"{kind} map"].T, ".", color=plots.LANDMARK, label="estimated landmarks")
    axes.plot(*arrays["truth"][:, :2].T, "--", color=plots.TRUTH, linewidth=0.9, label="true path")
    axes.plot(*arrays[f"{kind} poses"][:, :2].T, color=plots.ESTIMATE, linewidth=1.3, label="estimated path")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="box")
    axes.legend(fontsize=8)
    return figure


EXPERIMENTS = (_experiment(),)
