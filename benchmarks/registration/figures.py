# SPDX-License-Identifier: Apache-2.0
"""Tables 10.1 and 10.2 and Figs. 10.1-10.17 again: the thesis's plain ICP beside our ICP and NDT, 15 scans per motion.

    python benchmarks/registration/figures.py -o FOLDER [--bag TOF_TURNS]

The thesis's ICP starts from no motion with 20 % of the points and its rejection limits (0.5 m and 1.5 m); ours have no
guess and one setting. Writes ``motions.png``, the error of every scan, and with a bag ``trajectory.png`` (10.2.4,
10.3.4).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from grid import ROOM
from matplotlib.figure import Figure
from odometry import ours, scans_of_bag
from plain_icp import plain_icp

from ndt_registration.odometry import OdometryConfig
from ndt_registration.registration import RegistrationConfig, register
from slam_bringup.experiments.tof_scans import SCANS, THESIS_MOTIONS, TofRoom, rig_motion, rig_pose, thinned
from slam_core.geometry import FloatArray, boxminus

SHARE = 0.2
SUCCESS_M, SUCCESS_DEG = 0.05, 1.0
SHOWN_M, SHOWN_DEG = 1.5, 20.0
"""Height of the panels: what is farther off is drawn at their edge."""
Method = Callable[[FloatArray, FloatArray], FloatArray]


def by_register(method: str) -> Method:
    config = RegistrationConfig(method=method)
    return lambda source, target: register(source, target, config=config).T_target_source


METHODS: dict[str, Method] = {
    "plain ICP 0.5 m": lambda source, target: plain_icp(source, target, 0.5),
    "plain ICP 1.5 m": lambda source, target: plain_icp(source, target, 1.5),
    "ICP to planes": by_register("icp_plane"),
    "NDT": by_register("ndt"),
}


def errors_of_motions(scans: int) -> dict[str, dict[str, FloatArray]]:
    """Distance m, angle deg and ms of every scan (n, 3), by motion and method."""
    room, rng, start = TofRoom(str(ROOM)), np.random.default_rng(1), rig_pose(0.7, 1.9)
    found: dict[str, dict[str, FloatArray]] = {}
    for name, motion in THESIS_MOTIONS.items():
        truth = room.motion(motion)
        rows: dict[str, list[tuple[float, float, float]]] = {method: [] for method in METHODS}
        for _ in range(scans):
            source, target = thinned(room.scan(start @ rig_motion(motion), rng), SHARE, rng), room.scan(start, rng)
            for method, align in METHODS.items():
                began = time.perf_counter()
                d = boxminus(align(source, target), truth)
                ms = 1e3 * (time.perf_counter() - began)
                rows[method].append((float(np.linalg.norm(d[:3])), float(np.rad2deg(np.linalg.norm(d[3:]))), ms))
        found[name] = {method: np.array(values) for method, values in rows.items()}
        print_row(name, found[name])
    return found


def print_row(motion: str, errors: dict[str, FloatArray]) -> None:
    cells = []
    for e in errors.values():
        successes = int(((e[:, 0] < SUCCESS_M) & (e[:, 1] < SUCCESS_DEG)).sum())
        middle = np.median(e, axis=0)
        cells.append(f"{successes:2d}/{len(e)} {1e3 * middle[0]:6.1f} mm {middle[1]:6.2f} deg {middle[2]:5.0f} ms")
    print(f"{motion:20s} {'  | '.join(cells)}", flush=True)


def draw_motions(path: Path, found: dict[str, dict[str, FloatArray]]) -> None:
    """One column per motion: error in metres above, in degrees below, one mark per scan."""
    figure = Figure(figsize=(2.4 * len(found), 6), layout="constrained")
    panels = figure.subplots(2, len(found), sharex=True, sharey="row")
    for column, (motion, errors) in enumerate(found.items()):
        for row, limit in enumerate((SHOWN_M, SHOWN_DEG)):
            panel = panels[row, column]
            for mark, (method, e) in zip("x+.o", errors.items(), strict=True):
                panel.plot(np.arange(1, len(e) + 1), np.minimum(e[:, row], limit), mark, markersize=4, label=method)
            panel.axhline((SUCCESS_M, SUCCESS_DEG)[row], color="grey", linewidth=0.6)
            panel.set_yscale("symlog", linthresh=(0.01, 0.3)[row])
        panels[0, column].set_title(motion)
        panels[1, column].set_xlabel("scan")
    panels[0, 0].set_ylabel("translation error [m]")
    panels[1, 0].set_ylabel("rotation error [deg]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(METHODS))
    figure.savefig(path, dpi=80)


def draw_trajectories(path: Path, bag: Path) -> None:
    """The rig's way with turns by ICP and NDT odometry, from above and its height."""
    scans = scans_of_bag(bag)
    figure = Figure(figsize=(11, 5), layout="constrained")
    above, height = figure.subplots(1, 2)
    ways = {"truth": np.array([scan.truth[:3, 3] for scan in scans])}
    for method in ("icp", "icp_plane", "ndt"):
        config = OdometryConfig()
        run = ours(scans, replace(config, registration=replace(config.registration, method=method)))
        ways[method] = np.array([(scans[0].truth @ T)[:3, 3] for T in run.poses])
        off = 1e3 * np.linalg.norm(ways[method] - ways["truth"], axis=1)
        print(f"trajectory by {method:9s} {run.failed} failed, end {off[-1]:.1f} mm, at most {off.max():.1f} mm off")
    for name, way in ways.items():
        style = {"color": "black", "linewidth": 2.5, "alpha": 0.4} if name == "truth" else {"linewidth": 1.0}
        above.plot(way[:, 0], way[:, 1], label=name, **style)
        height.plot(1e3 * (way[:, 2] - way[0, 2]), label=name, **style)
    above.set_aspect("equal")
    above.set_xlabel("x [m]")
    above.set_ylabel("y [m]")
    height.set_xlabel("scan")
    height.set_ylabel("height [mm]")
    above.legend()
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--bag", type=Path, help="bag of the scenario tof_turns")
    parser.add_argument("--scans", type=int, default=SCANS)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    print(f"successes ({SUCCESS_M} m, {SUCCESS_DEG} deg), medians\n{'':20s} {', '.join(METHODS)}")
    draw_motions(arguments.output / "motions.png", errors_of_motions(arguments.scans))
    if arguments.bag is not None:
        draw_trajectories(arguments.output / "trajectory.png", arguments.bag)


if __name__ == "__main__":
    main()
