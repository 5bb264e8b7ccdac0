# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3 (stereo) beside ours on the same pairs: accuracy, scale, processor time.

    python benchmarks/chain/orbslam3.py --python VENV/bin/python [mh01|v101|kitti1|BAG ...] [--keep FOLDER]

VENV is an environment of its own with ``pip install orbslam3-python==2.0.0``; without ``--python`` this environment is
tried. Both get the pairs that our rectifier makes, ours from the bag itself. ORB-SLAM3 gets them at the recording's
rate, since it maps on other threads meanwhile, with the settings of its EuRoC example (on KITTI of that for KITTI) and
a vocabulary trained on the same pictures. Trajectories are laid on the truth rigidly; processor milliseconds are of all
threads per pair, ours with the dense model and the report left out. A BAG needs ground truth.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from recordings import RECORDINGS, _scale
from rich.console import Console
from rich.table import Table

from slam_bags.reading.readings import StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import associate, evaluate
from slam_core.geometry import invert_transform
from slam_core.runtime.memory import search_less_garbage, share_one_heap
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate, StereoImages
from stereo_frontend.stereo.rectify import StereoRectifier

RUN = Path(__file__).with_name("orbslam3_run.py")
"""Run with -P: this file has the name of the package."""
DEFAULT = ("mh01", "v101", "kitti1")
_TRUTH_GAP_S = 0.1
_EXAMPLES = {"kitti": (2000, 40.0), "": (1200, 60.0)}
"""Features and farthest depth in baselines of its examples KITTI00-02.yaml and EuRoC.yaml."""
_SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "Rectified"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera.width: {width}
Camera.height: {height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.b: {baseline}
Stereo.ThDepth: {farthest}
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=DEFAULT, metavar="RUN")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has orbslam3-python")
    parser.add_argument("--keep", type=Path, help="folder for bags and pictures")
    arguments = parser.parse_args()
    if subprocess.run([arguments.python, "-P", "-c", "import orbslam3"], check=False).returncode:
        install = "python -m venv VENV; VENV/bin/pip install orbslam3-python==2.0.0"
        parser.error(f"{arguments.python} has no orbslam3-python: {install}")
    table = Table("recording", "method", "poses", "ATE mm", "scale %", "processor ms/pair", title="ORB-SLAM3 and ours")
    with tempfile.TemporaryDirectory() as scratch:
        for run in arguments.runs:
            folder = (arguments.keep or Path(scratch)) / Path(run).stem
            folder.mkdir(parents=True, exist_ok=True)
            bag = bag_of(run, folder)
            for cells in (peer(bag, folder, arguments.python), ours(bag)):
                table.add_row(Path(run).stem, *cells)
                print(Path(run).stem, *cells, file=sys.stderr, flush=True)
    Console(width=120).print(table)


def bag_of(run: str, folder: Path) -> Path:
    """The bag of a recording's name, or the bag itself."""
    if run not in RECORDINGS:
        return Path(run)
    bag = folder / f"{run}.mcap"
    if not bag.exists():
        slam(["convert", *map(str, RECORDINGS[run].source), "-o", str(bag)], standalone_mode=False)
    return bag


def peer(bag: Path, folder: Path, python: str) -> list[str]:
    """ORB-SLAM3's figures."""
    with SensorBag(bag) as opened:
        agent = opened.agents[0]
        sensors, truth = opened.sensors[agent], opened.ground_truth(agent)
        T_base_left = sensors.transform("base", "left")
        write_pairs(opened, agent, folder)
    subprocess.run([python, "-P", str(RUN), str(folder)], check=True, stdout=subprocess.DEVNULL)
    found = np.load(folder / "trajectory.npz")
    poses = []
    for t, seen in zip(found["stamps"], found["T_camera_world"], strict=True):
        T_camera_world = np.vstack([seen, [0.0, 0.0, 0.0, 1.0]])
        T = T_base_left @ invert_transform(T_camera_world) @ invert_transform(T_base_left)
        poses.append(PoseEstimate(round(t * 1e9), T, np.eye(6)))
    assert truth is not None
    return ["ORB-SLAM3", *figures(Trajectory.from_estimates(poses), truth), f"{float(found['cpu_ms']):.0f}"]


def write_pairs(opened: SensorBag, agent: str, folder: Path) -> None:
    """Rectified pairs, stamps and settings."""
    sensors, stamps = opened.sensors[agent], []
    assert sensors.left is not None
    assert sensors.right is not None
    rectifier = StereoRectifier(sensors.left, sensors.right)
    for side in ("left", "right"):
        (folder / side).mkdir(exist_ok=True)
    pair: StereoImages | None = None
    for reading in opened.readings():
        if not isinstance(reading, StereoReading) or reading.agent != agent:
            continue
        pair = rectifier(reading.stamp_ns, reading.pair.left, reading.pair.right)
        for side, image in (("left", pair.left), ("right", pair.right)):
            cv2.imwrite(str(folder / side / f"{len(stamps):05d}.png"), image)
        stamps.append(1e-9 * reading.stamp_ns)
    assert pair is not None
    np.savetxt(folder / "stamps.txt", stamps, fmt="%.9f")
    camera = pair.stereo.camera
    features, farthest = _EXAMPLES["kitti" if folder.name.startswith("kitti") else ""]
    (folder / "settings.yaml").write_text(
        _SETTINGS.format(
            fx=float(camera.fx), fy=float(camera.fy), cx=float(camera.cx), cy=float(camera.cy), width=camera.width,
            height=camera.height, fps=max(1, round(1.0 / float(np.median(np.diff(stamps))))),
            baseline=float(pair.stereo.baseline), features=features, farthest=farthest,
        )
    )  # fmt: skip


def ours(bag: Path) -> list[str]:
    """Our figures on the same bag, stereo alone, with the memory's settings of ``slam run``."""
    share_one_heap()
    search_less_garbage()
    system = choose(load_system_config(None, bag), "stereo", "sjsam", "none", "off")
    system = replace(system, dense_mapper=replace(system.dense_mapper, use_stereo=False, use_tof=False))
    start = time.process_time()
    result, _ = run_bag(bag, system)
    ms = 1e3 * (time.process_time() - start) / max(result.frames, 1)
    agent = result.agents[0]
    return ["ours", *figures(agent.trajectory, agent.truth), f"{ms:.0f}"]


def figures(estimate: Trajectory, truth: Trajectory) -> list[str]:
    """Poses, ATE mm and scale error %."""
    e = evaluate(estimate, truth, interpolate=True, max_difference_s=_TRUTH_GAP_S)
    matched, true_poses = associate(estimate, truth, _TRUTH_GAP_S, interpolate=True)
    scale: float = _scale(matched.poses, true_poses)
    return [str(len(estimate)), f"{1e3 * e.ate.rmse:.1f}", f"{scale:+.2f}"]


if __name__ == "__main__":
    main()
