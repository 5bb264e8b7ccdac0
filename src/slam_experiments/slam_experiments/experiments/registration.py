# SPDX-License-Identifier: Apache-2.0
"""Chapter 10: ICP and NDT register scans of the laser camera; Tables 10.1 and 10.2, Figs. 10.1 to 10.18."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ndt_registration.methods.pyramid import GridConfig
from ndt_registration.registration import RegistrationConfig, register
from slam_core.geometry import boxminus
from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.experiments.chain import mapped
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_experiments.simulated.tof_scans import SCANS, THESIS_MOTIONS, TofRoom, rig_motion, rig_pose, thinned

MODULE = "slam_experiments.experiments.registration"
_PACKAGES = (*RENDERING, "tof_driver", "ndt_registration", "slam_experiments.simulated.tof_scans")
_METHODS = {"ndt": "NDT", "icp": "ICP, point to point", "icp_plane": "ICP, point to plane"}
_SHARES = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
_GRIDS = (0.5, 1.0, 1.5, 2.0, 3.0)
_START = rig_pose(0.7, 1.9)
_LONG = "round the workshop"
_GOOD_M, _GOOD_RAD = 0.05, np.radians(1.0)


def _motions(method: str, share: float = 0.2, scans: int = SCANS) -> Job:
    return Job(f"{MODULE}:register_motions", {"method": method, "share": share, "scans": scans}, _PACKAGES)


def _one_grid(edge: float, scans: int) -> Job:
    return Job(f"{MODULE}:register_on_one_grid", {"edge": edge, "scans": scans}, _PACKAGES)


def register_motions(folder: Path, before: list[Path], method: str, share: float, scans: int) -> Kept:
    """All motions of the thesis, ``scans`` scans each, no initial guess: tangents found and true, time, iterations."""
    room, rng, config = TofRoom(), np.random.default_rng(1), RegistrationConfig(method=method)
    found, true, seconds, iterations = [], [], [], []
    warm = room.scan(_START, rng)
    register(warm[:4000], warm[4000:8000], config=config)  # compiles
    for motion in THESIS_MOTIONS.values():
        for _ in range(scans):
            source = thinned(room.scan(_START @ rig_motion(motion), rng), share, rng)
            target = thinned(room.scan(_START, rng), share, rng)
            began = time.process_time()
            result = register(source, target, config=config)
            seconds.append(time.process_time() - began)
            iterations.append(result.iterations)
            found.append(boxminus(result.T_target_source, np.eye(4)))
            true.append(boxminus(room.motion(motion), np.eye(4)))
    shape = (len(THESIS_MOTIONS), scans)
    return {"method": method, "share": share}, {
        "found": np.reshape(found, (*shape, 6)),
        "true": np.reshape(true, (*shape, 6)),
        "seconds": np.reshape(seconds, shape),
        "iterations": np.reshape(iterations, shape),
    }


def register_on_one_grid(folder: Path, before: list[Path], edge: float, scans: int) -> Kept:
    """NDT as in the thesis: one grid of cells of ``edge`` m, from no motion, for (25, 25) cm; Table 10.1."""
    grid = replace(GridConfig(), voxel_size=edge, levels=1)
    room, rng, config = TofRoom(), np.random.default_rng(2), RegistrationConfig(grid=grid)
    motion = THESIS_MOTIONS["(25, 25) cm"]
    errors, iterations = [], []
    for _ in range(scans):
        source = thinned(room.scan(_START @ rig_motion(motion), rng), 0.2, rng)
        target = thinned(room.scan(_START, rng), 0.2, rng)
        result = register(source, target, initial_guess=np.eye(4), config=config)
        errors.append(boxminus(result.T_target_source, room.motion(motion)))
        iterations.append(result.iterations)
    return {"edge": edge}, {"errors": np.array(errors), "iterations": np.array(iterations)}


def _successes(result: JobResult) -> np.ndarray:
    """Mask (motions, scans) of registrations within 5 cm and 1 deg."""
    error = result.arrays["found"] - result.arrays["true"]
    return np.asarray(
        (np.linalg.norm(error[..., :3], axis=-1) < _GOOD_M) & (np.linalg.norm(error[..., 3:], axis=-1) < _GOOD_RAD)
    )


def _registration() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        scans = 2 if quick else SCANS
        chosen = {f"{method} 0.2": _motions(method, 0.2, scans) for method in _METHODS}
        if not quick:
            chosen |= {
                f"{method} {share}": _motions(method, share, 5)
                for method in ("ndt", "icp_plane")
                for share in _SHARES
                if share != 0.2
            }
        return chosen | {f"grid {edge}": _one_grid(edge, scans) for edge in _GRIDS}

    def report(results: Mapping[str, JobResult]) -> Findings:
        success = {method: _successes(results[f"{method} 0.2"]) for method in _METHODS}
        scans = success["ndt"].shape[1]
        comparisons = [
            Comparison(
                f"{name}: motions with all {scans} scans registered",
                thesis.NDT_GRID if method == "ndt" else thesis.ICP_TURNS,
                f"{int(np.all(success[method], axis=1).sum())} of {len(THESIS_MOTIONS)}",
                "all" if method == "ndt" else "",
                bool(success[method].all()) if method == "ndt" else None,
            )
            for method, name in _METHODS.items()
        ]
        seconds = float(np.median(results["ndt 0.2"].arrays["seconds"]))
        what = "time of one NDT registration, 20 % of the points"
        comparisons.append(Comparison(what, thesis.NDT_TIME, f"{seconds:.3f} s", "<= 0.1 s", seconds <= 0.1))
        return Findings(
            comparisons, [_success_table(success), _grid_table(results), _time_table(results)], _scan_pictures(results)
        )

    return Experiment("registration", "10.2-10.3", "ICP against NDT, fifteen scans a motion", jobs, report)


def _success_table(success: Mapping[str, np.ndarray]) -> Table:
    rows = [
        [name, *(f"{success[method][k].sum()} of {success[method].shape[1]}" for method in _METHODS)]
        for k, name in enumerate(THESIS_MOTIONS)
    ]
    return Table("Registered within 5 cm and 1 deg, 20 % of the points", ("motion", *_METHODS.values()), rows)


def _grid_table(results: Mapping[str, JobResult]) -> Table:
    rows = []
    for edge in _GRIDS:
        arrays = results[f"grid {edge}"].arrays
        error = 100.0 * np.abs(arrays["errors"][:, [2, 0]])  # optical z is forward, x sideways
        rows.append([f"{edge:g}", f"{np.median(arrays['iterations']):.0f}",
                     f"({np.median(error[:, 0]):.1f}, {np.median(error[:, 1]):.1f})"])  # fmt: skip
    return Table(
        "Table 10.1: NDT on one grid, (25, 25) cm", ("edge of the cells m", "iterations", "deviation (x, y) cm"), rows
    )


def _time_table(results: Mapping[str, JobResult]) -> Table:
    rows = []
    for share in _SHARES:
        cells = []
        for method in ("icp_plane", "ndt"):
            result = results.get(f"{method} {share}")
            cells += (
                ["", ""]
                if result is None
                else [f"{1e3 * np.median(result.arrays['seconds']):.0f}", f"{100.0 * _successes(result).mean():.0f}"]
            )
        rows.append([f"{100 * share:g}", *cells])
    header = ("points %", "ICP ms", "ICP success %", "NDT ms", "NDT success %")
    return Table("Table 10.2: time of a registration by share of the points (processor time)", header, rows)


def _scan_pictures(results: Mapping[str, JobResult]) -> list[Picture]:
    names = list(THESIS_MOTIONS)
    wanted = (
        ("icp", "forward 25 cm", "10.1"), ("icp", "forward 50 cm", "10.2"), ("icp", "forward 75 cm", "10.3, 10.4"),
        ("icp", "yaw +10 deg", "10.6"), ("ndt", "forward 25 cm", "10.8, 10.9"),
        ("ndt", "forward 50 cm", "10.10, 10.11"),
        ("ndt", "forward 75 cm", "10.12"), ("ndt", "forward 100 cm", "10.13"), ("ndt", "(25, 25) cm", "10.14"),
        ("ndt", "yaw +10 deg", "10.15"), ("ndt", "yaw -10 deg", "10.16"),
    )  # fmt: skip
    pictures = [
        Picture(
            plots.registrations(
                results[f"{method} 0.2"].arrays["found"][names.index(motion)], f"{_METHODS[method]}, {motion}"
            ),
            number,
            f"{_METHODS[method]}: what each scan of '{motion}' was registered to (camera's axes).",
        )
        for method, motion, number in wanted
    ]
    return [*pictures, Picture(_registered_clouds(), "10.17", "Two scans after registration, seen from above.")]


def _registered_clouds() -> Figure:
    room, rng = TofRoom(), np.random.default_rng(3)
    target, source = room.scan(_START, rng), room.scan(_START @ rig_motion(THESIS_MOTIONS["yaw 10 deg, 25 cm"]), rng)
    T = register(thinned(source, 0.2, rng), thinned(target, 0.2, rng)).T_target_source
    moved = source @ T[:3, :3].T + T[:3, 3]
    figure, axes = plots.new_figure(7, 5)
    for cloud, colour, label in ((target, "#1f77b4", "model"), (moved, "#d62728", "data, moved")):
        axes.plot(cloud[::5, 0], cloud[::5, 2], ",", color=colour, label=label)
    axes.set(xlabel="x [m]", ylabel="z [m]")
    axes.set_aspect("equal", adjustable="box")
    axes.legend(markerscale=20)
    return figure


def _from_the_start(result: JobResult) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the scan odometry, from the first true pose on, and the true ones (n, 4, 4)."""
    poses, truth = result.arrays["0 scans poses"], result.arrays["0 scans truth"]
    return truth[0] @ np.linalg.inv(poses[0]) @ poses, truth


def _drift(poses: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, float, str]:
    """Errors of position (n,) m, drift in percent of the way, and both it and the error of height in words."""
    way = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    error = np.linalg.norm((poses - truth)[:, :3, 3], axis=1)
    height = float(np.abs((poses - truth)[:, 2, 3]).max())
    drift = 100.0 * float(error[-1]) / way
    return error, drift, f"{drift:.2f} % of {way:.1f} m, {1e3 * height:.1f} mm"


def _trajectory() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        frames = 20 if quick else None
        turns = {name: mapped("tof_turns", "tof", odometry=name, frames=frames) for name in ("icp", "ndt")}
        return turns | {_LONG: mapped("workshop_rig", "tof", odometry="ndt", frames=frames)}

    def report(results: Mapping[str, JobResult]) -> Findings:
        comparisons, rows = [], []
        figure, axes = plots.new_figure(7, 5)
        for name, claim in (("icp", thesis.ICP_PATH), ("ndt", thesis.NDT_PATH)):
            aligned, truth = _from_the_start(results[name])
            error, drift, drifted = _drift(aligned, truth)
            comparisons.append(
                Comparison(
                    f"{name.upper()}: drift, largest error of height",
                    claim,
                    drifted,
                    "< 1 %" if name == "ndt" else "",
                    bool(drift < 1.0) if name == "ndt" else None,
                )
            )
            rows.append([name, f"{1e3 * np.sqrt(np.mean(error**2)):.1f}", f"{1e3 * error[-1]:.1f}", f"{drift:.2f}"])
            axes.plot(aligned[:, 0, 3], aligned[:, 1, 3], linewidth=1.2, label=name.upper())
            axes.plot(truth[:, 0, 3], truth[:, 1, 3], "--", color="0.2", linewidth=0.8)
        drifted = _drift(*_from_the_start(results[_LONG]))[2]
        comparisons.append(Comparison(f"the same of NDT {_LONG}", thesis.NDT_PATH, drifted))
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal", adjustable="box")
        axes.legend()
        table = Table("Scan odometry over two turns", ("method", "ATE mm", "end mm", "drift %"), rows)
        return Findings(comparisons, [table], [Picture(figure, "10.7, 10.18", "Trajectories; dashed: truth.")])

    return Experiment("scan_trajectory", "10.2.3, 10.3.4", "A trajectory from scans alone", jobs, report)


EXPERIMENTS = (_registration(), _trajectory())
