# SPDX-License-Identifier: Apache-2.0
"""2D laser logs: wheel odometry, scan odometry on top of it, and loops closed by the same registration.

aces is judged by its 1279 manual relations, which stand on a grid of 5 cm; intel has none, so it is judged by how far
each trajectory is from closing the loops that were found. ``-o`` draws the maps.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from laser_log import LaserScan, read_log, relation_errors, relation_spans, stamp_ns, wheel_motion
from laser_loops import LoopCloser, planar
from planar_graph import relative

from ndt_registration.odometry import OdometryStatus, ScanOdometry
from slam_core.geometry import FloatArray

LOG_NAMES = ("aces", "intel")
SPANS_S = (0.0, 60.0, 300.0, np.inf)
DRAWN_RANGE = 10.0
Trajectories = dict[str, list[FloatArray]]


def track(scans: list[LaserScan]) -> tuple[list[FloatArray], int]:
    """Poses by scan odometry, default settings, wheels as prior; failed registrations."""
    odometry = ScanOdometry()
    results = [odometry.process(stamp_ns(scans[0]), scans[0].points)]
    for before, now in pairwise(scans):
        results.append(odometry.process(stamp_ns(now), now.points, wheel_motion(before, now)))
    lost = (OdometryStatus.FAILED, OdometryStatus.RESTARTED)
    return [result.T for result in results], sum(result.status in lost for result in results)


def statistics(errors: FloatArray) -> str:
    (mean, turn), (spread, turn_spread) = errors.mean(axis=0), errors.std(axis=0)
    return f"{mean:.3f} +- {spread:.3f} m, {turn:.2f} +- {turn_spread:.2f} deg"


def judge_by_relations(path: Path, scans: list[LaserScan], trajectories: Trajectories) -> None:
    spans = relation_spans(path)
    for name, poses in trajectories.items():
        errors = relation_errors(path, scans, poses)
        print(f"{name:14s} all {len(errors)} relations: {statistics(errors)}; median {np.median(errors[:, 0]):.3f} m")
        for low, high in pairwise(SPANS_S):
            chosen = errors[(spans >= low) & (spans < high)]
            print(f"{'':14s} {len(chosen):4d} over {low:.0f} to {high:.0f} s: {statistics(chosen)}")


def judge_by_loops(closer: LoopCloser, trajectories: Trajectories) -> None:
    ends = [(closer.nodes[loop.earlier], closer.nodes[loop.later]) for loop in closer.loops]
    for name, poses in trajectories.items():
        d = np.array(
            [
                relative(planar(poses[a]), planar(poses[b])) - loop.pose
                for (a, b), loop in zip(ends, closer.loops, strict=True)
            ]
        )
        turn = np.rad2deg(np.abs(np.arctan2(np.sin(d[:, 2]), np.cos(d[:, 2]))))
        print(f"{name:14s} from closing its loops: {statistics(np.column_stack([np.hypot(d[:, 0], d[:, 1]), turn]))}")


def draw(path: Path, scans: list[LaserScan], trajectories: Trajectories) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7 * len(trajectories), 7), layout="constrained")
    for k, (name, poses) in enumerate(trajectories.items()):
        panel = figure.add_subplot(1, len(trajectories), k + 1, aspect="equal", title=name)
        clouds = [
            scan.points[np.linalg.norm(scan.points, axis=1) < DRAWN_RANGE] @ T[:2, :2].T + T[:2, 3]
            for scan, T in list(zip(scans, poses, strict=True))[::5]
        ]
        points, way = np.concatenate(clouds), np.array([T[:2, 3] for T in poses])
        panel.plot(points[:, 0], points[:, 1], "k,", alpha=0.3)
        panel.plot(way[:, 0], way[:, 1], "-", color="tab:red", linewidth=0.7)
        panel.set_xlabel("x [m]")
        panel.set_ylabel("y [m]")
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with aces.clf.bz2, aces.relations, ...")
    parser.add_argument("--logs", nargs="+", default=LOG_NAMES, help="names of the logs")
    parser.add_argument("--every", type=int, default=1, help="use every n-th scan")
    parser.add_argument("-o", "--output", type=Path, help="folder for the maps")
    arguments = parser.parse_args()
    for name in arguments.logs:
        scans = read_log(arguments.data / f"{name}.clf.bz2", arguments.every)
        began = time.perf_counter()
        tracked, failures = track(scans)
        took = 1e3 * (time.perf_counter() - began) / len(scans)
        closer = LoopCloser(scans, tracked)
        trajectories = {"wheels": [scan.T for scan in scans], "scan odometry": tracked, "with loops": closer.run()}
        print(
            f"\n{name}: {len(scans)} scans, {failures} failed registrations, {took:.1f} ms per scan, "
            f"{len(closer.nodes)} nodes, {len(closer.loops)} loops"
        )
        relations = arguments.data / f"{name}.relations"
        if relations.exists():
            judge_by_relations(relations, scans, trajectories)
        judge_by_loops(closer, trajectories)
        if arguments.output is not None:
            arguments.output.mkdir(parents=True, exist_ok=True)
            draw(arguments.output / f"{name}.png", scans, trajectories)


if __name__ == "__main__":
    main()
