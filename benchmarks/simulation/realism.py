# SPDX-License-Identifier: Apache-2.0
"""Is the simulation as hard as reality? The same measurements on simulated and on real recordings.

    python benchmarks/simulation/realism.py [--data FOLDER] [--frames N]

Each recording becomes a bag, and each bag is measured by one piece of code, stereo pairs and depth cameras apart: how
much of the picture has texture and of the depth image depth, SIFT features, those with depth, vertical residual of
rectified matches, how many frames a feature lives, by how much the depths of a feature in neighbouring frames disagree,
and the pose between neighbours by PnP against the truth. Simulated recordings, of both profiles, are thinned so that
neighbours are as far apart as in the real ones. Real ones that are not there are skipped.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from slam_bags.datasets.euroc import EurocDataset
from slam_bags.datasets.files import Dataset
from slam_bags.datasets.kitti import KittiDataset
from slam_bags.datasets.rgbd import RgbdDataset
from slam_bags.reading.readings import DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.commands.convert import convert
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.sensor_pipeline import depth_stage
from slam_core.camera import Camera
from slam_core.geometry import FloatArray, invert_transform, make_transform, so3_log
from slam_core.types import ByteArray
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_simulation.sensors.profiles import PROFILES
from stereo_frontend.stereo.rectify import StereoRectifier

RATIO = 0.8
REPROJECTION_PX = 2.0
_TEXTURE = 3.0


@dataclass
class View:
    """One frame: keypoints, descriptors and points (n, 3) in the camera, NaN where there is no depth."""

    uv: FloatArray
    descriptors: np.ndarray
    points: FloatArray
    camera: Camera
    T_world_camera: FloatArray
    vertical: FloatArray
    texture: float
    known: float


@dataclass
class Figures:
    """What is measured on one recording."""

    features: list[int] = field(default_factory=list)
    depths: list[int] = field(default_factory=list)
    vertical: list[float] = field(default_factory=list)
    texture: list[float] = field(default_factory=list)
    known: list[float] = field(default_factory=list)
    disagreement: list[float] = field(default_factory=list)
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
        disagree = 1.48 * median(np.abs(self.disagreement)) if self.disagreement else np.nan
        return (
            f"{name:34s} {100 * np.mean(self.texture):5.0f} {100 * np.mean(self.known):5.0f} "
            f"{median(self.features):6.0f} {median(self.depths):6.0f} {spread:7.2f} "
            f"{np.mean(self.lives):6.2f} {100 * disagree:7.2f} "
            f"{len(self.errors):4d}/{self.pairs:<4d} {1e3 * moved:7.0f} {turned:6.2f} {1e3 * e_t:7.1f} {e_r:7.3f}"
        )


HEADER = (
    f"{'recording':34s} {'tex %':>5s} {'dep %':>5s} {'SIFT':>6s} {'depth':>6s} {'dv px':>7s} {'life':>6s} "
    f"{'depth %':>7s} {'solved':>9s} {'step mm':>7s} "
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
    points = camera.unproject(uv, depth)
    return View(uv, descriptors, points, camera, T, shift[good, 1], textured(left), np.nan)


def textured(image: ByteArray) -> float:
    """Share of pixels with a gradient of 3 grey levels a pixel after a blur of 1.5 px, which noise does not reach."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float32)
    gradient = [cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, scale=0.125) for dx in (0, 1)]
    return float(np.mean(np.hypot(*gradient) > _TEXTURE))


def depth_view(picture: np.ndarray, depth: np.ndarray, camera: Camera, T: FloatArray) -> View:
    """Depth from a depth image of the same camera."""
    low, high = np.percentile(picture, [1, 99])  # an amplitude has no scale of its own
    image = np.clip(255.0 * (picture - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)
    uv, descriptors = detect(image)
    u, v = np.rint(uv).astype(int).T
    z = depth[np.clip(v, 0, camera.height - 1), np.clip(u, 0, camera.width - 1)].astype(float)
    points = camera.unproject(uv, np.where(z > 0, z, np.nan))
    return View(uv, descriptors, points, camera, T, np.empty(0), textured(image), float(np.mean(depth > 0)))


def views(bag: Path, stride: int, frames: int, camera: str) -> Iterator[View]:
    """Frames of a bag's ``camera``, stereo or depth, with their truth, every ``stride``-th."""
    with SensorBag(bag) as source:
        agent = source.agents[0]
        sensors, truth = source.sensors[agent], source.ground_truth(agent)
        assert truth is not None
        stage = depth_stage(SystemConfig(), sensors)
        kind = StereoReading if camera == "stereo" else DepthReading
        T_base_camera = sensors.transform("base", "left" if camera == "stereo" else "tof")
        own = (r for r in source.readings() if isinstance(r, kind) and r.agent == agent)
        for k, reading in enumerate(own):
            if k % stride or k // stride >= frames:
                continue
            nearest = int(np.argmin(np.abs(truth.stamps_ns - reading.stamp_ns)))
            T = truth.poses[nearest] @ T_base_camera
            if isinstance(reading, StereoReading):
                assert sensors.left is not None
                assert sensors.right is not None
                pair = StereoRectifier(sensors.left, sensors.right)(
                    reading.stamp_ns, reading.pair.left, reading.pair.right
                )
                yield stereo_view(pair.left, pair.right, pair.stereo.camera, pair.stereo.baseline, T)
            else:
                stage.add(reading.raw)
                for image in stage.ready():
                    assert image.amplitude is not None
                    yield depth_view(image.amplitude, image.depth, image.camera, T)


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
        out.texture.append(view.texture)
        out.known.append(view.known)
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
        before, after = a.points[pairs[:, 0]] @ T[2, :3] + T[2, 3], b.points[pairs[:, 1], 2]
        out.disagreement.extend(((after - before) / before)[np.isfinite(after)].tolist())
        error = T @ invert_transform(truth)
        turn = float(np.degrees(np.linalg.norm(so3_log(error[:3, :3]))))
        out.errors.append((float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), turn))
        new_age[pairs[:, 1]] = age[pairs[:, 0]] + 1
        ended[pairs[:, 0]] = False
    out.lives.extend(age[ended].tolist())
    return new_age


def real_bags(data: Path, folder: Path) -> Iterator[tuple[str, Path, int, str]]:
    """Real recordings that are there: name, bag, stride, camera."""
    sources: dict[str, tuple[Callable[[], Dataset], int, str]] = {
        "EuRoC V1_01 (keyframes)": (
            lambda: EurocDataset(
                data / "euroc_v101_visnav100/euroc_V1",
                data / "euroc_v101_micro95/MicroEurocDataset/mav0",
                data / "traj_gt_openvins/euroc_mav/V1_01_easy.txt",
            ),
            1,
            "stereo",
        ),
        "EuRoC MH_01 (each 2nd)": (lambda: EurocDataset(data / "euroc_mh01_10hz"), 2, "stereo"),
        "KITTI (outdoors)": (lambda: KittiDataset(data / "kitti_stereo_51x2/KITTI_sequence_1"), 1, "stereo"),
        "HoloLens (each 3rd), depth": (lambda: RgbdDataset(data / "hololens_office_120"), 3, "depth"),
        "redkitchen (each 5th), depth": (lambda: RgbdDataset(data / "rgbd_tsdf_1000"), 5, "depth"),
    }
    for name, (make, stride, camera) in sources.items():
        try:
            bag = folder / name.replace(" ", "_").split("(")[0]
            convert(make(), bag)
        except (ValueError, OSError) as error:
            print(f"{name:34s} skipped: {error}")
            continue
        yield name, bag, stride, camera


SIMULATED = (
    ("figure_eight", 25, ("stereo",)),
    ("small_room", 16, ("stereo", "depth")),
    ("workshop_handheld", 12, ("stereo",)),
    ("conference", 12, ("stereo",)),
    ("workshop_rig", 6, ("stereo", "depth")),
)
"""Scenario, stride and cameras: neighbours about as far apart as EuRoC's keyframes, the last as MH_01's frames."""


def simulated_bags(folder: Path, frames: int) -> Iterator[tuple[str, Path, int, str]]:
    """Simulated recordings of both profiles, only as many frames as are looked at."""
    for name, stride, cameras in SIMULATED:
        for profile in PROFILES:
            scenario = Scenario.load(name).shortened(stride * frames).with_profile(profile)
            bag = folder / f"{name}_{profile}"
            write_bag(scenario, bag, BagOptions(every=stride))
            for camera in cameras:
                yield f"{name} /{stride}, {profile}{', depth' * (camera == 'depth')}", bag, 1, camera


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2].parent / "shared/data")
    parser.add_argument("--frames", type=int, default=40, help="frames of each recording")
    arguments = parser.parse_args()
    print(HEADER)
    with tempfile.TemporaryDirectory() as folder:
        for source in (real_bags(arguments.data, Path(folder)), simulated_bags(Path(folder), arguments.frames)):
            for name, bag, stride, camera in source:
                print(measure(views(bag, stride, arguments.frames, camera)).row(name), flush=True)


if __name__ == "__main__":
    main()
