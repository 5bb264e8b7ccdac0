# SPDX-License-Identifier: Apache-2.0
"""Every real recording in one table: accuracy and honesty, alone, with scan odometry, with and without the IMU.

    python benchmarks/chain/recordings.py [NAME ...] [--json FILE] [--keep FOLDER] [--no-peers] [--config FILE]

NAME: mh01, v101, kitti1, kitti2, hololens, redkitchen (default: those whose data are there). A row is one run of
``slam run``'s pipeline: ATE (rigidly aligned) and end error mm, scale of the path, claimed position sigma over ATE,
ANEES as it is and with the errors that the ground truth itself has (``doubt.py``), frames lost, processor
milliseconds per frame of all stages. "filter" is the same run without joining. Peers: frame to frame SIFT and PnP
(``../ekf/ground_truth.py`` for stereo, here for depth) and GICP (small_gicp, where it is installed).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.reading.readings import AgentSensors, DepthReading, Reading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import EXACT_TRUTH, associate, evaluate
from slam_core.geometry import FloatArray, invert_transform, make_transform
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from slam_viewer.report.output import write_results

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "ekf"))
from doubt import TRUTH, doubted

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data"))
_TRUTH_GAP_S = 0.1
"""True poses are interpolated between neighbours at most this far apart."""
_RATIO, _LEAST_INLIERS, _LARGEST_STEP_M = 0.8, 20, 3.0


@dataclass(frozen=True)
class Recording:
    """How to convert it, the mode, the kinds of run, and what is known of its truth (a name in ``doubt.TRUTH``)."""

    source: tuple[str | Path, ...]
    mode: str
    runs: tuple[str, ...]
    truth: str


_DEPTH_RUNS = ("alone", "ndt")
_EUROC = (
    "--calibration",
    DATA / "euroc_v101_micro95" / "MicroEurocDataset",
    "--ground-truth",
    DATA / "traj_gt_openvins" / "euroc_mav" / "V1_01_easy.txt",
)
RECORDINGS = {
    "mh01": Recording(("euroc", DATA / "euroc_mh01_10hz"), "stereo", ("imu", "alone"), "euroc"),
    "v101": Recording(("euroc", DATA / "euroc_v101_visnav100" / "euroc_V1", *_EUROC), "stereo", ("alone",), "euroc"),
    "kitti1": Recording(("kitti", DATA / "kitti_stereo_51x2" / "KITTI_sequence_1"), "stereo", ("alone",), "kitti"),
    "kitti2": Recording(("kitti", DATA / "kitti_stereo_51x2" / "KITTI_sequence_2"), "stereo", ("alone",), "kitti"),
    "hololens": Recording(("rgbd", DATA / "hololens_office_120"), "tof", _DEPTH_RUNS, "hololens"),
    "redkitchen": Recording(("rgbd", DATA / "rgbd_tsdf_1000"), "tof", _DEPTH_RUNS, "redkitchen"),
}


@dataclass(frozen=True)
class Row:
    """One line of the table; lengths in mm, None where a figure has no meaning."""

    recording: str
    run: str
    frames: int
    ate_mm: float
    end_mm: float
    scale_percent: float
    sigma_over_ate: float | None
    anees: float | None
    anees_with_truth_errors: float | None
    lost: int
    ms_per_frame: float | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    present = [name for name, recording in RECORDINGS.items() if Path(recording.source[1]).exists()]
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
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


def _rows(name: str, folder: Path, peers: bool, config: Path | None = None) -> Iterator[Row]:
    recording = RECORDINGS[name]
    bag = folder / f"{name}.mcap"
    if not bag.exists():
        slam(["convert", *map(str, recording.source), "-o", str(bag)], standalone_mode=False)
    for run in recording.runs:
        yield from _own(name, bag, recording, run, folder / f"{name}_{run}", config)
    if peers:
        yield _pnp(name, bag, recording)
        if recording.mode == "tof":
            yield from _gicp(name, bag)


# ---- our own runs
def _own(name: str, bag: Path, recording: Recording, run: str, output: Path, config: Path | None) -> Iterator[Row]:
    odometry = "ndt" if run == "ndt" else "none"
    system = choose(load_system_config(config), recording.mode, "sjsam", odometry, "on" if run == "imu" else "off")
    start = time.process_time()
    result, session = run_bag(bag, system, odometry=odometry)
    ms = 1e3 * (time.process_time() - start) / max(result.frames, 1)
    write_results(output, result, lambda path: session.save(path).result())
    agent = result.agents[0]
    lost = result.rejections.get("frames_lost", 0)
    yield row_of(name, run, agent.trajectory, agent.truth, recording.truth, lost, ms)
    yield row_of(name, f"{run}, filter", agent.filtered, agent.truth, recording.truth, lost, None)
    if len(agent.scan_odometry):
        yield row_of(name, f"{run}, scans", agent.scan_odometry, agent.truth, recording.truth, 0, None)


def row_of(
    name: str, run: str, estimate: Trajectory, truth: Trajectory, known: str, lost: int, ms: float | None
) -> Row:
    matched, true_poses = associate(estimate, truth, _TRUTH_GAP_S, interpolate=True)
    e = evaluate(estimate, truth, interpolate=True, max_difference_s=_TRUTH_GAP_S)
    sigma = in_doubt = None
    if matched.covariances is not None:
        sigma = float(np.sqrt(np.mean(np.trace(matched.covariances[:, :3, :3], axis1=1, axis2=2)))) / e.ate.rmse
        accuracy = TRUTH.get(known, EXACT_TRUTH)
        wide = doubted(estimate) if known in ("kitti", "euroc") else estimate
        in_doubt = evaluate(wide, truth, interpolate=True, max_difference_s=_TRUTH_GAP_S, accuracy=accuracy).anees
    return Row(
        name, run, len(estimate), 1e3 * e.ate.rmse, 1e3 * e.end_error_m, _scale(matched.poses, true_poses), sigma,
        e.anees, in_doubt, lost, ms,
    )  # fmt: skip


def _scale(estimate: FloatArray, truth: FloatArray) -> float:
    """By how many per cent the estimate is larger than the truth about their centres."""
    sizes = [np.linalg.norm(T[:, :3, 3] - T[:, :3, 3].mean(axis=0)) for T in (estimate, truth)]
    return float(100.0 * (sizes[0] / sizes[1] - 1.0))


# ---- peers, from frame to frame
def _pnp(name: str, bag: Path, recording: Recording) -> Row:
    """SIFT, ratio test, PnP with RANSAC on the points of the frame before; a frame that fails repeats the motion."""
    stamps, poses, lost, motion = [], [np.eye(4)], 0, np.eye(4)
    before = None
    with SensorBag(bag) as opened:
        sensors, truth = opened.sensors[""], opened.ground_truth("")
        T_base = sensors.transform("base", "tof" if recording.mode == "tof" else "left")
        for reading in opened.readings():
            frame = _points(reading, sensors)
            if frame is None:
                continue
            stamps.append(reading.stamp_ns)
            if before is not None:
                found = _solve(before, frame)
                lost += found is None
                motion = motion if found is None else found
                poses.append(poses[-1] @ T_base @ motion @ invert_transform(T_base))
            before = frame
    assert truth is not None
    return row_of(name, "SIFT + PnP", _trajectory(stamps, poses), truth, "", lost, None)


def _points(reading: Reading, sensors: AgentSensors) -> tuple | None:
    """SIFT keypoints, descriptors, points in the optical frame (nan where unknown) and K of one frame."""
    if isinstance(reading, DepthReading):
        raw = reading.raw
        grey = raw.amplitude if raw.amplitude is not None else raw.intensity
        if grey is None:
            return None
        grey = cv2.normalize(grey.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        keypoints, descriptors = cv2.SIFT_create(1500).detectAndCompute(grey, None)
        uv = np.array([k.pt for k in keypoints])
        camera, depth = sensors.tof.camera, _metres(reading)
        return uv, descriptors, camera.unproject(uv, depth[tuple(np.round(uv[:, ::-1]).astype(int).T)]), camera.K
    if isinstance(reading, StereoReading):
        from stereo_frontend.stereo.rectify import StereoRectifier

        pair = StereoRectifier(sensors.left, sensors.right)(reading.stamp_ns, reading.pair.left, reading.pair.right)
        from ground_truth import stereo_points

        uv, points, descriptors = stereo_points(pair)
        return uv, descriptors, points, pair.stereo.camera.K
    return None


def _metres(reading: DepthReading) -> FloatArray:
    """Depth along z, m; nan where there is none."""
    image = reading.raw.image
    depth = np.asarray(image, dtype=np.float64) * (1e-3 if image.dtype == np.uint16 else 1.0)
    return np.where(depth > 0.1, depth, np.nan)


def _solve(before: tuple, now: tuple) -> FloatArray | None:
    """T_before_now of the camera, or None."""
    found = cv2.BFMatcher().knnMatch(before[1], now[1], k=2)
    pairs = [(m[0].queryIdx, m[0].trainIdx) for m in found if len(m) == 2 and m[0].distance < _RATIO * m[1].distance]
    pairs = [(a, b) for a, b in pairs if np.isfinite(before[2][a]).all()]
    if len(pairs) < _LEAST_INLIERS:
        return None
    points = np.array([before[2][a] for a, _ in pairs])
    pixels = np.array([now[0][b] for _, b in pairs])
    cv2.setRNGSeed(0)
    ok, turn, shift, inliers = cv2.solvePnPRansac(points, pixels, now[3], None, None, None, False, 1000, 2.0, 0.999)
    if not ok or inliers is None or len(inliers) < _LEAST_INLIERS:
        return None
    chosen = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], now[3], None, turn, shift)
    if np.linalg.norm(shift) > _LARGEST_STEP_M:
        return None
    return invert_transform(make_transform(cv2.Rodrigues(turn)[0], shift.ravel()))


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
            points = camera.unproject(pixels, _metres(reading).ravel())
            points = points[np.isfinite(points).all(axis=1)]
            stamps.append(reading.stamp_ns)
            cloud = small_gicp.preprocess_points(points, downsampling_resolution=0.03)
            if target is not None:
                motion = small_gicp.align(*target[:1], cloud[0], target[1], motion).T_target_source
                poses.append(poses[-1] @ T_base @ motion @ invert_transform(T_base))
            target = cloud
    assert truth is not None
    yield row_of(name, "GICP", _trajectory(stamps, poses), truth, "", 0, None)


def _trajectory(stamps: list[int], poses: list[FloatArray]) -> Trajectory:
    estimates = [PoseEstimate(s, T, np.eye(6)) for s, T in zip(stamps, poses, strict=True)]
    return replace(Trajectory.from_estimates(estimates), covariances=None)


# ---- output
def _cells(row: Row) -> list[str]:
    def text(value: float | None, digits: int) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    return [
        row.recording, row.run, str(row.frames), text(row.ate_mm, 1), text(row.end_mm, 1), f"{row.scale_percent:+.2f}",
        text(row.sigma_over_ate, 1), text(row.anees, 1), text(row.anees_with_truth_errors, 2), str(row.lost),
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
