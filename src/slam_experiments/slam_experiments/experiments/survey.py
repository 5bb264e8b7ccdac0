# SPDX-License-Identifier: Apache-2.0
"""Sections 6.3 to 6.6: what a step of each technique costs as the map grows, on the same planar worlds.

One EKF updates the covariance of all landmarks at every step. Batch smoothing solves for everything whenever it is
asked. The sparse information filter drops links between the pose and landmarks. iSAM2 (GTSAM, where it is installed)
relinearises what changed. Conditionally independent submaps share what is in view where they meet. Joined submaps
filter in maps of bounded size and join each when it is full.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from slam_core.geometry import FloatArray
from slam_experiments import thesis
from slam_experiments.experiments.planar import filter_run, graph_of
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_experiments.linear_slam.text_joining import join_text_maps
from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf
from slam_experiments.planar.independent import IndependentSubmaps
from slam_experiments.planar.log import PlanarLog, RobotLog
from slam_experiments.planar.mapping import map_log, submaps_of
from slam_experiments.planar.sam import smooth
from slam_experiments.planar.seif import PlanarSeif
from slam_simulation.planar import PlanarRun, PlanarWorldConfig, simulate_planar

MODULE = "slam_experiments.experiments.survey"
TECHNIQUES = {
    "one EKF": "one_filter",
    "SEIF": "seif",
    "conditionally independent submaps": "independent",
    "batch SAM": "batch",
    "iSAM2 (GTSAM)": "isam2",
    "joined submaps (ours)": "submaps",
}
_LAST_STEPS = 20
_BATCHES = 3
_MISSING = "install gtsam"
"""Cell of what only a peer could fill."""


def world(size: int) -> PlanarWorldConfig:
    """A drive once round among ``size`` landmarks of the same density, a step about as long whatever the size."""
    scale = float(np.sqrt(size / 40.0))
    return replace(
        PlanarWorldConfig(),
        landmarks=size,
        size=10.0 * scale,
        radius=3.0 * scale,
        samples=max(50, round(60 * scale)),
        sigma_turn=0.005,
    )


def cost_of_a_step(folder: Path, before: list[Path], technique: str, size: int) -> Kept:
    """Processor seconds of a step at the end of a drive among ``size`` landmarks, and how good the map is."""
    run = simulate_planar(world(size), np.random.default_rng(size))
    if technique == "isam2" and importlib.util.find_spec("gtsam") is None:
        return {"missing": _MISSING}, {}
    seconds, poses, numbers = _RUNNERS[technique](run)
    error = float(np.sqrt(np.mean(np.sum((poses - run.poses)[:, :2] ** 2, axis=1))))
    return {"seconds": seconds, "rmse_m": error, "numbers": numbers}, {}


def _one_filter(run: PlanarRun) -> tuple[float, FloatArray, int]:
    config, Q = _noise(run)
    ekf = PlanarEkf(config, run.poses[0], np.diag([1e-9, 1e-9, 1e-9]))
    poses, elapsed = [], []
    for k, seen in enumerate(run.observations):
        began = time.process_time()
        if k:
            ekf.predict(run.odometry[k - 1], Q)
        ekf.process(np.column_stack([seen.ranges, seen.bearings]), seen.ids)
        elapsed.append(time.process_time() - began)
        poses.append(ekf.pose.copy())
    return float(np.mean(elapsed[-_LAST_STEPS:])), np.array(poses), ekf.covariance.dense().size


def _seif(run: PlanarRun) -> tuple[float, FloatArray, int]:
    config, _ = _noise(run)
    return _stepped(run, PlanarSeif(config, run.poses[0], 1e-9 * np.eye(3)))


def _independent(run: PlanarRun) -> tuple[float, FloatArray, int]:
    config, _ = _noise(run)
    return _stepped(run, IndependentSubmaps(config, run.poses[0], 1e-9 * np.eye(3)))


def _stepped(run: PlanarRun, technique: PlanarSeif | IndependentSubmaps) -> tuple[float, FloatArray, int]:
    """Mean time of the last steps, in which the loop is closed; poses as they were when they were the newest."""
    Q, poses, elapsed = _noise(run)[1], [], []
    for k, seen in enumerate(run.observations):
        began = time.process_time()
        if k:
            technique.predict(run.odometry[k - 1], Q)
        technique.process(np.column_stack([seen.ranges, seen.bearings]), seen.ids)
        elapsed.append(time.process_time() - began)
        poses.append(technique.pose.copy())
    return float(np.mean(elapsed[-_LAST_STEPS:])), np.array(poses), technique.numbers


def _batch(run: PlanarRun) -> tuple[float, FloatArray, int]:
    ekf, _, slots = filter_run(run, known=True)
    graph, elapsed = graph_of(run, slots), []
    for _ in range(_BATCHES):
        began = time.process_time()
        smoothed = smooth(graph, run.poses[0], ekf.config)[0]
        elapsed.append(time.process_time() - began)
    return float(np.median(elapsed)), smoothed.poses, 9 * len(graph.motions) + 10 * len(graph.measured)


def _submaps(run: PlanarRun) -> tuple[float, FloatArray, int]:
    """All submaps are joined anew, in batch, whenever one is full; the mean over the whole drive."""
    config, Q = _noise(run)
    n = len(run.odometry)
    robot = RobotLog(
        "robot",
        np.arange(float(n + 1)),
        run.odometry,
        np.broadcast_to(Q, (n, 3, 3)),
        tuple(np.column_stack([o.ranges, o.bearings]) for o in run.observations),
        tuple(o.ids for o in run.observations),
        run.poses,
    )
    began = time.process_time()
    texts = []
    for submap in submaps_of(robot, config):
        texts.append(submap.text)
        join_text_maps(texts, 2)
    elapsed = time.process_time() - began
    log = PlanarLog("survey", (robot,), config.sigma_range, config.sigma_bearing)
    poses = map_log(log, "submaps").paths[0].poses
    return elapsed / (n + 1), poses, sum(text.information.size for text in texts)


def _isam2(run: PlanarRun) -> tuple[float, FloatArray, int]:
    import gtsam  # a peer, not a dependency

    c = run.config
    isam, elapsed, pose = gtsam.ISAM2(), [], gtsam.Pose2(*run.poses[0])
    X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    motion_noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.sigma_step, c.sigma_step, c.sigma_turn]))
    seen_noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.sigma_bearing, c.sigma_range]))
    known: set[int] = set()
    for k, seen in enumerate(run.observations):
        began = time.process_time()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k:
            motion = gtsam.Pose2(*run.odometry[k - 1])
            graph.add(gtsam.BetweenFactorPose2(X(k - 1), X(k), motion, motion_noise))
            pose = pose.compose(motion)
        else:
            graph.add(gtsam.PriorFactorPose2(X(0), pose, gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
        values.insert(X(k), pose)
        for i, r, b in zip(seen.ids.tolist(), seen.ranges, seen.bearings, strict=True):
            graph.add(gtsam.BearingRangeFactor2D(X(k), L(i), gtsam.Rot2(b), r, seen_noise))
            if i not in known:
                known.add(i)
                values.insert(L(i), pose.transformFrom(np.array([r * np.cos(b), r * np.sin(b)])))
        isam.update(graph, values)
        pose = isam.calculateEstimatePose2(X(k))
        elapsed.append(time.process_time() - began)
    estimate = isam.calculateEstimate()
    poses = [estimate.atPose2(X(k)) for k in range(len(run.observations))]
    array = np.array([[p.x(), p.y(), p.theta()] for p in poses])
    return float(np.mean(elapsed[-_LAST_STEPS:])), array, int(isam.getFactorsUnsafe().size())


_RUNNERS = {
    "one_filter": _one_filter,
    "seif": _seif,
    "independent": _independent,
    "batch": _batch,
    "isam2": _isam2,
    "submaps": _submaps,
}


def _noise(run: PlanarRun) -> tuple[PlanarConfig, FloatArray]:
    c = run.config
    Q = np.diag(np.array([c.sigma_step, c.sigma_step, c.sigma_turn]) ** 2)
    return PlanarConfig(sigma_range=c.sigma_range, sigma_bearing=c.sigma_bearing), Q


_NOT_BUILT = (
    "Not built: constrained local submap filters (CLSF), whose global filter takes in each local map at the price of"
    " one EKF's update; CI-Graph, whose conditionally independent submaps form a graph where ours form a chain;"
    " exactly sparse information filters, which avoid SEIF's overconfidence by forgetting measurements at"
    " each relocation; compressed filters, whose full update is one EKF's; Atlas, which never makes one map of all;"
    " Tectonic SAM, whose submaps stay graphs that are solved anew where ours are Gaussians; FastSLAM, whose particles"
    " forget the correlations that close large loops."
)


@dataclass(frozen=True)
class _Growth:
    """Milliseconds, thousands of numbers and RMSE m by size, and the exponents fitted to the last three sizes."""

    ms: list[float]
    thousands: list[float]
    rmse: list[float]
    time_exponent: float
    memory_exponent: float


def _growth(found: list[dict[str, Any]], sizes: list[int]) -> _Growth | None:
    """Growth of a technique's cost; None where it could not be run."""
    if any("missing" in values for values in found):
        return None
    ms = [1e3 * values["seconds"] for values in found]
    thousands = [values["numbers"] / 1e3 for values in found]
    exponents = [float(np.polyfit(np.log(sizes[-3:]), np.log(cost[-3:]), 1)[0]) for cost in (ms, thousands)]
    return _Growth(ms, thousands, [values["rmse_m"] for values in found], *exponents)


_STEP = (
    "Processor time of a step, ms: mean of the last twenty, in which the loop closes; joined submaps: mean of all,"
    " joining included; batch SAM: one solution"
)


def _table(
    title: str,
    growth: Mapping[str, _Growth | None],
    sizes: list[int],
    values: Callable[[_Growth], list[float]],
    exponent: Callable[[_Growth], float] | None = None,
) -> Table:
    """One quantity of all techniques by size, with the exponent of its growth."""
    header = ["technique", *(f"{size} landmarks" for size in sizes), *(["exponent"] if exponent else [])]
    rows = []
    for name, g in growth.items():
        if g is None:
            rows.append([name, _MISSING, *[""] * (len(header) - 2)])
            continue
        rows.append([name, *(f"{value:.3g}" for value in values(g)), *([f"{exponent(g):.2f}"] if exponent else [])])
    return Table(title, header, rows)


def _landmarks_of(numbers: int) -> int:
    """Number n of landmarks in the map of one EKF, whose covariance has (3 + 2 n)^2 numbers."""
    return round((float(np.sqrt(numbers)) - 3.0) / 2.0)


def _growth_figure(growth: Mapping[str, _Growth], sizes: list[int]) -> Figure:
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, g in growth.items():
        left.loglog(sizes, g.ms, "o-", markersize=3, label=f"{name}, n^{g.time_exponent:.1f}")
        right.loglog(sizes, g.thousands, "o-", markersize=3, label=f"{name}, n^{g.memory_exponent:.1f}")
    left.set(xlabel="landmarks in the map", ylabel="processor time of a step [ms]")
    right.set(xlabel="landmarks in the map", ylabel="numbers stored [thousands]")
    for axes in (left, right):
        axes.legend(fontsize=7)
    return figure


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        sizes = (40, 160) if quick else (40, 160, 640, 1280, 2560)
        packages = (*RENDERING, "ekf_slam_node", "sjsam_node", "slam_experiments.planar")
        return {
            f"{name}|{size}": Job(f"{MODULE}:cost_of_a_step", {"technique": technique, "size": size}, packages)
            for name, technique in TECHNIQUES.items()
            for size in sizes
        }

    def report(results: Mapping[str, JobResult]) -> Findings:
        worlds = sorted({int(key.split("|")[1]) for key in results})
        sizes = [_landmarks_of(results[f"one EKF|{world}"].values["numbers"]) for world in worlds]
        growth = {name: _growth([results[f"{name}|{world}"].values for world in worlds], sizes) for name in TECHNIQUES}
        usable = {name: g for name, g in growth.items() if g is not None}
        ours, ekf = usable["joined submaps (ours)"], usable["one EKF"]
        tables = [
            _table(_STEP, growth, sizes, lambda g: g.ms, lambda g: g.time_exponent),
            _table("Numbers stored, thousands", growth, sizes, lambda g: g.thousands, lambda g: g.memory_exponent),
            _table("RMSE of the path, m: of filters each pose when it was the newest", growth, sizes, lambda g: g.rmse),
        ]
        return Findings(
            [
                Comparison("growth of a step's time: one EKF, joined submaps", thesis.EKF_GROWTH,
                           f"n^{ekf.time_exponent:.1f}, n^{ours.time_exponent:.1f}", "submaps grow more slowly",
                           ours.time_exponent < ekf.time_exponent),
                Comparison("growth of memory: one EKF, joined submaps", thesis.EKF_GROWTH,
                           f"n^{ekf.memory_exponent:.1f}, n^{ours.memory_exponent:.1f}", "submaps grow more slowly",
                           ours.memory_exponent < ekf.memory_exponent),
            ],
            tables,
            [Picture(_growth_figure(usable, sizes), "", "Time of a step and numbers stored, by size of the map.")],
            _NOT_BUILT,
        )  # fmt: skip

    return Experiment("survey", "6.3-6.6", "What a step costs as the map grows", jobs, report)


EXPERIMENTS = (_experiment(),)
