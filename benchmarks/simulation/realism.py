# SPDX-License-Identifier: Apache-2.0
"""Is the simulation as hard as reality? The same measurements on simulated and on real recordings.

    python benchmarks/simulation/realism.py [--data FOLDER] [--frames N]

Each recording becomes a bag, and each bag is measured by one piece of code: SIFT features, stereo matches, vertical
residual of the rectified matches, how many frames a feature lives, and the pose between neighbouring frames by PnP
against the truth. Simulated recordings are thinned so that neighbours are as far apart as in the real ones. Real ones
that are not there are skipped. redkitchen has no second camera: its depth image takes the place of the stereo match.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from slam_bringup.bags.readings import DepthReading, StereoReading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.commands.convert import convert
from slam_bringup.commands.simulate import BagOptions, write_bag
from slam_bringup.datasets.euroc import EurocDataset
from slam_bringup.datasets.files import Dataset
from slam_bringup.datasets.kitti import KittiDataset
from slam_bringup.datasets.rgbd import RgbdDataset
from slam_core.camera import Camera
from slam_core.config import from_mapping
from slam_core.geometry import FloatArray, invert_transform, make_transform, so3_log
from slam_core.types import ByteArray
from slam_simulation import Scenario
from slam_simulation.scenario import SensorSuite
from stereo_frontend.rectify import StereoRectifier

RATIO = 0.8
REPROJECTION_PX = 2.0


@dataclass
class View:
    """One frame: keypoints, descriptors and points (n, 3) in the camera, NaN where there is no depth."""

    uv: FloatArray
    descriptors: np.ndarray
    points: FloatArray
    camera: Camera
    T_world_camera: FloatArray
    vertical: FloatArray


@dataclass
class Figures:
    """What is measured on one recording."""

    features: list[int] = field(default_factory=list)
    depths: list[int] = field(default_factory=list)
    vertical: list[float] = field(default_factory=list)
    lives: list[int] = field(default_factory=list)
    steps: list[tuple[float, float]] = field(default_factory=list)
    errors: list[tuple[float, float]] = field(default_factory=list)
    pairs: int = 0

    def row(self, name: str) -> str:
        """One line of the table."""
        median = np.median
        moved, turned = median(self.steps, axis=0)
        e_t, e_r = median(self.errors, axis=0) if self.errors else (np.nan, np.nan)
        spread = 1.48 * median(np.abs(self.vertical)) if self.vertical else np.nan
        return (
            f"{name:26s} {median(self.features):6.0f} {median(self.depths):6.0f} {spread:7.2f} "
            f"{np.mean(self.lives):6.2f} "
            f"{len(self.errors):4d}/{self.pairs:<4d} {1e3 * moved:7.0f} {turned:6.2f} {1e3 * e_t:7.1f} {e_r:7.3f}"
        )


HEADER = (
    f"{'recording':26s} {'SIFT':>6s} {'depth':>6s} {'dv px':>7s} {'life':>6s} {'solved':>9s} {'step mm':>7s} "
    f"{'deg':>6s} {'PnP mm':>7s} {'deg':>7s}"
)


def match(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mutual nearest neighbours that pass the ratio test: index pairs (m, 2)."""
    if len(a) < 2 or len(b) < 2:
        return np.empty((0, 2), dtype=int)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(a, b, 2) if m.distance < RATIO * n.distance}
    backward = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(b, a, 2) if m.distance < RATIO * n.distance}
    return np.array([(i, j) for i, j in forward.items() if backward.get(j) == i], dtype=int).reshape(-1, 2)


def detect(image: ByteArray) -> tuple[FloatArray, np.ndarray]:
    """SIFT with OpenCV's own thresholds."""
    sift = cv2.SIFT_create()  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(image, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    return np.array([k.pt for k in keypoints]), descriptors


def stereo_view(left: ByteArray, right: ByteArray, camera: Camera, baseline: float, T: FloatArray) -> View:
    """Depth from a rectified pair."""
    uv, descriptors = detect(left)
    other, other_descriptors = detect(right)
    pairs = match(descriptors, other_descriptors)
    shift = uv[pairs[:, 0]] - other[pairs[:, 1]]
    good = (shift[:, 0] > 1.0) & (np.abs(shift[:, 1]) < 2.0)
    depth = np.full(len(uv), np.nan)
    depth[pairs[good, 0]] = camera.fx * baseline / shift[good, 0]
    return View(uv, descriptors, camera.unproject(uv, depth), camera, T, shift[good, 1])


def depth_view(image: ByteArray, depth: np.ndarray, camera: Camera, T: FloatArray) -> View:
    """Depth from a depth image of the same camera."""
    uv, descriptors = detect(image)
    u, v = np.rint(uv).astype(int).T
    z = depth[np.clip(v, 0, camera.height - 1), np.clip(u, 0, camera.width - 1)].astype(float)
    return View(uv, descriptors, camera.unproject(uv, np.where(z > 0, z, np.nan)), camera, T, np.empty(0))


def views(bag: Path, stride: int, frames: int) -> Iterator[View]:
    """Frames of a bag with their truth, every ``stride``-th."""
    with SensorBag(bag) as source:
        agent = source.agents[0]
        sensors, truth = source.sensors[agent], source.ground_truth(agent)
        assert truth is not None
        rectifier = StereoRectifier(sensors.left, sensors.right) if sensors.left and sensors.right else None
        kind = StereoReading if rectifier else DepthReading
        T_base_camera = sensors.transform("base", "left" if rectifier else "tof")
        own = (r for r in source.readings() if isinstance(r, kind) and r.agent == agent)
        for k, reading in enumerate(own):
            if k % stride or k // stride >= frames:
                continue
            nearest = int(np.argmin(np.abs(truth.stamps_ns - reading.stamp_ns)))
            T = truth.poses[nearest] @ T_base_camera
            if isinstance(reading, StereoReading):
                assert rectifier is not None
                pair = rectifier(reading.stamp_ns, reading.pair.left, reading.pair.right)
                yield stereo_view(pair.left, pair.right, pair.stereo.camera, pair.stereo.baseline, T)
            else:
                scale = 0.001 if reading.raw.image.dtype == np.uint16 else 1.0
                assert sensors.tof is not None
                assert reading.raw.amplitude is not None
                yield depth_view(reading.raw.amplitude, reading.raw.image * scale, sensors.tof.camera, T)


def relative_pose(a: View, b: View, pairs: np.ndarray) -> tuple[FloatArray, np.ndarray] | None:
    """T_b_a by PnP on the points of ``a`` seen in ``b``, and the matches that agree; None without enough."""
    known = pairs[np.isfinite(a.points[pairs[:, 0], 2])]
    if len(known) < 8:
        return None
    points, pixels = a.points[known[:, 0]], b.uv[known[:, 1]]
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        points, pixels, b.camera.K, None, iterationsCount=300, reprojectionError=REPROJECTION_PX, confidence=0.999
    )
    if not ok or inliers is None or len(inliers) < 12:
        return None
    inliers = inliers[:, 0]
    rvec, tvec = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], b.camera.K, None, rvec, tvec)
    rotation, translation = np.asarray(cv2.Rodrigues(rvec)[0], dtype=float), np.asarray(tvec, dtype=float).ravel()
    return make_transform(rotation, translation), known[inliers]


def measure(recording: Iterator[View]) -> Figures:
    """All figures of one recording."""
    out, previous, age = Figures(), None, np.empty(0, dtype=int)
    for view in recording:
        out.features.append(len(view.uv))
        out.depths.append(int(np.isfinite(view.points[:, 2]).sum()))
        out.vertical.extend(view.vertical.tolist())
        new_age = np.ones(len(view.uv), dtype=int)
        if previous is not None:
            age = _compare(previous, view, age, new_age, out)
        previous, age = view, new_age
    out.lives.extend(age.tolist())
    return out


def _compare(a: View, b: View, age: np.ndarray, new_age: np.ndarray, out: Figures) -> np.ndarray:
    """Neighbouring frames: pose error, and which features live on."""
    truth = invert_transform(b.T_world_camera) @ a.T_world_camera
    out.pairs += 1
    out.steps.append((float(np.linalg.norm(truth[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(truth[:3, :3]))))))
    solved = relative_pose(a, b, match(a.descriptors, b.descriptors))
    ended = np.ones(len(age), dtype=bool)
    if solved is not None:
        T, pairs = solved
        error = T @ invert_transform(truth)
        turn = float(np.degrees(np.linalg.norm(so3_log(error[:3, :3]))))
        out.errors.append((float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), turn))
        new_age[pairs[:, 1]] = age[pairs[:, 0]] + 1
        ended[pairs[:, 0]] = False
    out.lives.extend(age[ended].tolist())
    return new_age


def real_bags(data: Path, folder: Path) -> Iterator[tuple[str, Path, int]]:
    """Real recordings that are there: name, bag, stride."""
    sources: dict[str, Callable[[], Dataset]] = {
        "EuRoC V1_01 (keyframes)": lambda: EurocDataset(
            data / "euroc_v101_visnav100/euroc_V1",
            data / "euroc_v101_micro95/MicroEurocDataset/mav0",
            data / "traj_gt_openvins/euroc_mav/V1_01_easy.txt",
        ),
        "KITTI (outdoors)": lambda: KittiDataset(data / "kitti_stereo_51x2/KITTI_sequence_1"),
        "redkitchen, each 5th": lambda: RgbdDataset(data / "rgbd_tsdf_1000/data"),
    }
    for name, make in sources.items():
        try:
            bag = folder / name.split()[0]
            convert(make(), bag)
        except (ValueError, OSError) as error:
            print(f"{name:26s} skipped: {error}")
            continue
        yield name, bag, 5 if name.startswith("redkitchen") else 1


SIMULATED = (("figure_eight", 25), ("small_room", 16), ("workshop_handheld", 12), ("conference", 12), ("firemen_2", 5))
"""Scenario and stride: neighbours about as far apart as EuRoC's keyframes."""
MISCALIBRATION_PX = 0.05
"""Error of the calibration in the last lines: what a good calibration of a real pair leaves."""


def simulated_bags(folder: Path, frames: int) -> Iterator[tuple[str, Path, int]]:
    """Simulated recordings, only as many frames as are looked at."""
    for name, stride in SIMULATED:
        scenario = Scenario.load(name).shortened(stride * frames)
        write_bag(scenario, folder / name, BagOptions(every=stride))
        yield f"{name} /{stride}", folder / name, 1
    wrong = from_mapping(SensorSuite, {"stereo": {"calibration_error_px": MISCALIBRATION_PX}})
    for name, stride in SIMULATED[:2]:
        scenario = replace(Scenario.load(name).shortened(stride * frames), suite=wrong)
        write_bag(scenario, folder / f"{name}_wrong", BagOptions(every=stride))
        yield f"{name} /{stride} +-{MISCALIBRATION_PX}px", folder / f"{name}_wrong", 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2].parent / "shared/data")
    parser.add_argument("--frames", type=int, default=40, help="frames of each recording")
    arguments = parser.parse_args()
    print(HEADER)
    with tempfile.TemporaryDirectory() as folder:
        for source in (real_bags(arguments.data, Path(folder)), simulated_bags(Path(folder), arguments.frames)):
            for name, bag, stride in source:
                print(measure(views(bag, stride, arguments.frames)).row(name), flush=True)


if __name__ == "__main__":
    main()
