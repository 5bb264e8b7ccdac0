# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3 (stereo or RGB-D) on a bag, by its binding orbslam3-python in an interpreter of its own.

It gets the pairs that our rectifier makes, or picture and depth as recorded, at the recording's rate, since it maps on
other threads meanwhile, with the settings of its own examples and a vocabulary trained on the same pictures.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from slam_bags.reading.readings import AgentSensors, DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_core.camera import Camera
from slam_core.geometry import invert_transform
from slam_core.trajectory import Trajectory
from slam_core.types import AnyArray
from slam_experiments.benchmark.visual_odometry import depth_m, grey_picture, without_covariances
from stereo_frontend.stereo.rectify import StereoRectifier

PROGRAM = Path(__file__).with_name("orbslam3_program.py")
"""Run with -P: a file beside it has the name of the package."""
INSTALL = "python -m venv VENV; VENV/bin/pip install orbslam3-python==2.0.0; --orbslam3 VENV/bin/python"
_EXAMPLES = {"kitti": (2000, 40.0), "stereo": (1200, 60.0), "tof": (1000, 40.0)}
"""Features and farthest depth in baselines of its examples KITTI00-02.yaml, EuRoC.yaml and (RGB-D) TUM1.yaml."""
_RGBD_BASELINE_M = 0.07732
"""Stereo.b of TUM1.yaml: a depth camera has none, and the farthest depth counts in it."""
_SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "{kind}"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.b: {baseline}
Stereo.ThDepth: {farthest}
RGBD.DepthMapFactor: 1.0
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


def is_there(python: str) -> bool:
    """True if an interpreter has the binding."""
    try:
        return subprocess.run([python, "-P", "-c", "import orbslam3"], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def orbslam3(bag: Path, mode: str, example: str, python: str, folder: Path) -> tuple[Trajectory, float]:
    """Poses of the rig, and processor milliseconds per frame of all its threads; ``folder`` for its input.

    Raises
    ------
    ValueError
        If it ends without poses, or the camera is not one that it reads.
    """
    with SensorBag(bag) as opened:
        sensors = opened.sensors[opened.agents[0]]
        T_base_camera = sensors.transform("base", "tof" if mode == "tof" else "left")
        _write_input(opened, sensors, mode, example, folder)
    done = subprocess.run([python, "-P", str(PROGRAM), str(folder)], capture_output=True, text=True, check=False)
    if done.returncode or not (folder / "trajectory.npz").exists():
        raise ValueError(f"ORB-SLAM3 ended with {done.returncode}: {' '.join(done.stderr.split())[-200:]}")
    with np.load(folder / "trajectory.npz") as found:
        stamps, seen, ms = found["stamps"], found["T_camera_world"], float(found["cpu_ms"])
    poses = []
    for T in seen:
        T_camera_world = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
        poses.append(T_base_camera @ invert_transform(T_camera_world) @ invert_transform(T_base_camera))
    if len(poses) < 2:
        raise ValueError("ORB-SLAM3 found no poses")
    return without_covariances([round(t * 1e9) for t in stamps], poses), ms


def _write_input(opened: SensorBag, sensors: AgentSensors, mode: str, example: str, folder: Path) -> None:
    """Pictures, stamps and settings."""
    frames = _pairs(opened, sensors) if mode == "stereo" else _depth_frames(opened, sensors)
    stamps: list[float] = []
    rig: tuple[Camera, float] | None = None
    for stamp_ns, pictures, rig in frames:  # noqa: B007 (that of the last frame counts)
        for name, picture in pictures.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            path = folder / name / f"{len(stamps):05d}"
            if name == "depth":
                np.save(path.with_suffix(".npy"), picture)
            else:
                cv2.imwrite(str(path.with_suffix(".png")), picture)
        stamps.append(1e-9 * stamp_ns)
    if rig is None or len(stamps) < 2:
        raise ValueError("fewer than two frames")
    camera, baseline = rig
    np.savetxt(folder / "stamps.txt", stamps, fmt="%.9f")
    features, farthest = _EXAMPLES[example]
    settings = _SETTINGS.format(
        kind="Rectified" if mode == "stereo" else "PinHole", fx=float(camera.fx), fy=float(camera.fy),
        cx=float(camera.cx), cy=float(camera.cy), width=camera.width, height=camera.height,
        fps=max(1, round(1.0 / float(np.median(np.diff(stamps))))), baseline=float(baseline), features=features,
        farthest=farthest,
    )  # fmt: skip
    (folder / "settings.yaml").write_text(settings, encoding="utf-8")


_Input = Iterator[tuple[int, dict[str, AnyArray], tuple[Camera, float]]]
"""Stamp, pictures by folder, and camera with baseline, of each frame."""


def _pairs(opened: SensorBag, sensors: AgentSensors) -> _Input:
    if sensors.left is None or sensors.right is None:
        raise ValueError("the bag has no pair of cameras")
    rectifier = StereoRectifier(sensors.left, sensors.right)
    for reading in opened.readings():
        if isinstance(reading, StereoReading):
            pair = rectifier(reading.stamp_ns, reading.pair.left, reading.pair.right)
            yield reading.stamp_ns, {"left": pair.left, "right": pair.right}, (pair.stereo.camera, pair.stereo.baseline)


def _depth_frames(opened: SensorBag, sensors: AgentSensors) -> _Input:
    if sensors.tof is None or not sensors.tof.camera.is_rectified:
        raise ValueError("the depth camera is distorted, or there is none")
    for reading in opened.readings():
        if isinstance(reading, DepthReading):
            depth = np.nan_to_num(depth_m(reading, sensors), nan=0.0).astype(np.float32)
            pictures = {"left": grey_picture(reading), "depth": depth}
            yield reading.stamp_ns, pictures, (sensors.tof.camera, _RGBD_BASELINE_M)
