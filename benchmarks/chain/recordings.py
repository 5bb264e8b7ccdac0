# SPDX-License-Identifier: Apache-2.0
"""Every real recording in one table: accuracy and honesty, alone, with scan odometry, with and without the IMU.

    python benchmarks/chain/recordings.py [NAME ...] [--json FILE] [--keep FOLDER] [--no-peers] [--config FILE]

NAME: mh01, v101, kitti1, kitti2, hololens, redkitchen (default: those whose data are there). A row is one run of
``slam run``'s pipeline: ATE (rigidly aligned) and end error mm, scale of the path, claimed position sigma over ATE,
ANEES as it is and with the errors that the ground truth itself has, frames lost, processor milliseconds per frame of
all stages. "filter" is the same run without joining. Peers: frame to frame SIFT and PnP, and GICP (small_gicp, where
it is installed). Variants of the recordings, ORB-SLAM3 and before against after: ``slam benchmark``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.reading.readings import DepthReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.geometry import invert_transform
from slam_core.trajectory import Trajectory
from slam_experiments.benchmark.figures import Figures, figures_of
from slam_experiments.benchmark.recording_sets import RecordingSet, public_sets
from slam_experiments.benchmark.visual_odometry import depth_m, frame_to_frame, without_covariances
from slam_viewer.report.output import write_results

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = public_sets(Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data")))
_DEFAULT = ("mh01", "v101", "kitti1", "kitti2", "hololens", "redkitchen")


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    recording: str
    run: str
    figures: Figures
    lost: int
    ms_per_frame: float | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    present = [name for name in _DEFAULT if RECORDINGS[name].source.exists()]
    parser.add_argument("names", nargs="*", default=present, metavar="NAME")
    parser.add_argument("--json", type=Path, help="write the rows there too")
    parser.add_argument("--keep", type=Path, help="folder for bags and results")
    parser.add_argument("--no-peers", action="store_true", help="only our own runs")
    parser.add_argument("--config", type=Path, help="parameters of all nodes, as slam run takes them")
    arguments = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for name in arguments.names:
            for row in _rows(name, folder, not arguments.no_peers, arguments.config):
                rows.append(row)
                print(_line(row), file=sys.stderr, flush=True)
    Console(width=150).print(_table(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps([_as_json(row) for row in rows], indent=1) + "\n")


def _rows(name: str, folder: Path, peers: bool, config: Path | None = None) -> Iterator[Row]:
    recording = RECORDINGS[name]
    bag = folder / f"{name}.mcap"
    if not bag.exists():
        recording.write_bag(bag)
    for run in recording.runs:
        yield from _own(name, bag, recording, run, folder / f"{name}_{run}", config)
    if peers:
        trajectory, lost = frame_to_frame(bag, recording.mode)
        with SensorBag(bag) as opened:
            truth = opened.ground_truth("")
        assert truth is not None
        yield Row(name, "SIFT + PnP", figures_of(trajectory, truth, ""), lost, None)
        if recording.mode == "tof":
            yield from _gicp(name, bag)


# ---- our own runs
def _own(name: str, bag: Path, recording: RecordingSet, run: str, output: Path, config: Path | None) -> Iterator[Row]:
    odometry = "ndt" if run == "ndt" else "none"
    system = choose(load_system_config(config), recording.mode, "sjsam", odometry, "on" if run == "imu" else "off")
    start = time.process_time()
    result, session = run_bag(bag, system, odometry=odometry)
    ms = 1e3 * (time.process_time() - start) / max(result.frames, 1)
    write_results(output, result, lambda path: session.save(path).result())
    agent = result.agents[0]
    lost = result.rejections.get("frames_lost", 0)

    def row(label: str, trajectory: Trajectory, lost: int, ms: float | None) -> Row:
        return Row(name, label, figures_of(trajectory, agent.truth, recording.truth), lost, ms)

    yield row(run, agent.trajectory, lost, ms)
    yield row(f"{run}, filter", agent.filtered, lost, None)
    if len(agent.scan_odometry):
        yield row(f"{run}, scans", agent.scan_odometry, 0, None)


# ---- peers
def _gicp(name: str, bag: Path) -> Iterator[Row]:
    """GICP of each depth image to the one before, from the motion before."""
    try:
        import small_gicp
    except ImportError:
        return
    stamps, poses, motion, target = [], [np.eye(4)], np.eye(4), None
    with SensorBag(bag) as opened:
        sensors, truth = opened.sensors[""], opened.ground_truth("")
        T_base, camera = sensors.transform("base", "tof"), sensors.tof.camera
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].reshape(2, -1)
        pixels = np.column_stack([u, v]).astype(np.float64)
        for reading in opened.readings():
            if not isinstance(reading, DepthReading):
                continue
            points = camera.unproject(pixels, depth_m(reading, sensors).ravel())
            points = points[np.isfinite(points).all(axis=1)]
            stamps.append(reading.stamp_ns)
            cloud = small_gicp.preprocess_points(points, downsampling_resolution=0.03)
            if target is not None:
                motion = small_gicp.align(*target[:1], cloud[0], target[1], motion).T_target_source
                poses.append(poses[-1] @ T_base @ motion @ invert_transform(T_base))
            target = cloud
    assert truth is not None
    yield Row(name, "GICP", figures_of(without_covariances(stamps, poses), truth, ""), 0, None)


# ---- output
def _as_json(row: Row) -> dict[str, object]:
    named = {"recording": row.recording, "run": row.run}
    return {**named, **asdict(row.figures), "lost": row.lost, "ms_per_frame": row.ms_per_frame}


def _cells(row: Row) -> list[str]:
    f = row.figures

    def text(value: float | None, digits: int) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    return [
        row.recording, row.run, str(f.frames), text(f.ate_mm, 1), text(f.end_mm, 1), f"{f.scale_percent:+.2f}",
        text(f.sigma_over_ate, 1), text(f.anees, 1), text(f.anees_with_truth_errors, 2), str(row.lost),
        text(row.ms_per_frame, 0),
    ]  # fmt: skip


_HEADINGS = (
    "recording", "run", "frames", "ATE mm", "end mm", "scale %", "sigma / ATE", "ANEES",
    "with truth's errors", "lost", "CPU ms",
)  # fmt: skip


def _line(row: Row) -> str:
    return ", ".join(f"{heading} {cell}" for heading, cell in zip(_HEADINGS, _cells(row), strict=True) if cell)


def _table(rows: list[Row]) -> Table:
    table = Table(title="real recordings against ground truth")
    for heading in _HEADINGS:
        table.add_column(heading, justify="left" if heading in ("recording", "run") else "right")
    for row in rows:
        table.add_row(*_cells(row))
    return table


if __name__ == "__main__":
    main()
