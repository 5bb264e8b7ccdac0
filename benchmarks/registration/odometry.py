# SPDX-License-Identifier: Apache-2.0
"""Scan odometry of depth cameras against the truth, beside others' (``pip install small_gicp kiss-icp``).

GICP of small_gicp registers each frame to the one before; KISS-ICP registers it to its map, with its own defaults but
the camera's range, once more with ``min_motion_th`` of 1 cm in place of a car's 10 cm, and without its threads.

    python benchmarks/registration/odometry.py [--bags BAG ...] [--redkitchen FOLDER] [--set name=value ...]

Drift is the distance at the end over the path; height the largest error along the world's z. NEES is that of the
motions from scan to scan over 6: median, mean and what 99 % stay below; 0.9, 1 and 2.8 where their covariances tell the
truth. Milliseconds are processor time. Lost scans are those that no pose was found for. For redkitchen (7-Scenes) two
methods also register distant frames directly: how far both are from the data set's poses is what its depth and its
poses disagree by.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ndt_registration.clouds.cloud import finite_points
from ndt_registration.odometry import OdometryConfig, OdometryStatus, ScanOdometry
from ndt_registration.registration import RegistrationConfig, register
from slam_bags.reading.readings import DepthReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.sensor_pipeline import depth_stage
from slam_core.config import from_mapping
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, boxminus, invert_transform
from slam_core.types import AnyArray

FOCAL_PX, CENTRE_PX = 585.0, (320.0, 240.0)
PERIOD_NS = 33_333_333
NEAREST, FARTHEST = 0.3, 7.5
"""Range of the cameras, m."""
REDKITCHEN_FRAMES = 200
DISTANT = ((0, 50), (0, 100), (0, 150), (0, 199))
HEADINGS = (
    f"{'sequence':18s} {'method':9s}   lost  ATE mm  drift %  end deg  height mm  step mm    deg"
    "   NEES: median mean 99 %  ms (95 %)"
)


@dataclass(frozen=True, eq=False)
class Scan:
    """Stamp, points (..., 3) m in the sensor's frame, true pose T_world_sensor."""

    stamp_ns: int
    points: AnyArray
    truth: FloatArray

    def cloud(self) -> FloatArray:
        """Finite points (n, 3)."""
        return finite_points(self.points)


@dataclass(frozen=True, eq=False)
class Run:
    """Poses T_first_sensor, motions' normalised squared errors over 6, ms per scan, failed registrations."""

    poses: list[FloatArray]
    nees: list[float]
    milliseconds: list[float]
    failed: int


def scans_of_bag(path: Path) -> list[Scan]:
    """Every depth image of a bag with ground truth."""
    scans = []
    with SensorBag(path) as bag:
        agent = bag.agents[0]
        sensors, truth = bag.sensors[agent], bag.ground_truth(agent)
        assert truth is not None
        stage, T_base_tof = depth_stage(SystemConfig(), sensors), sensors.transform("base", "tof")
        poses = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))
        for reading in bag.readings():
            if isinstance(reading, DepthReading):
                stage.add(reading.raw)
                for depth in stage.ready():
                    scans.append(Scan(reading.stamp_ns, depth.points(), poses[reading.stamp_ns] @ T_base_tof))
    return scans


def scans_of_redkitchen(folder: Path) -> list[Scan]:
    """7-Scenes frames: 16-bit depth in mm, every third pixel; their rotations are orthonormal to four digits only."""
    scans = []
    v, u = np.mgrid[0:480:3, 0:640:3]
    for k in range(REDKITCHEN_FRAMES):
        depth = cv2.imread(str(folder / f"frame-{k:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        assert depth is not None
        z = depth[::3, ::3].astype(np.float64) / 1000.0
        z[(z < 0.3) | (z > 6.0)] = np.nan
        points = np.stack([(u - CENTRE_PX[0]) / FOCAL_PX * z, (v - CENTRE_PX[1]) / FOCAL_PX * z, z], axis=-1)
        truth = np.loadtxt(folder / f"frame-{k:06d}.pose.txt")
        left, _, right = np.linalg.svd(truth[:3, :3])
        truth[:3, :3] = left @ right
        scans.append(Scan(1 + k * PERIOD_NS, points.reshape(-1, 3), truth))
    return scans


def ours(scans: list[Scan], config: OdometryConfig) -> Run:
    odometry, run = ScanOdometry(config), Run([], [], [], 0)
    failed = 0
    for before, scan in zip([scans[0], *scans], scans, strict=False):
        began = time.thread_time()
        result = odometry.process(scan.stamp_ns, scan.points)
        run.milliseconds.append(1e3 * (time.thread_time() - began))
        run.poses.append(result.T)
        failed += result.status in (OdometryStatus.FAILED, OdometryStatus.RESTARTED)
        if result.motion is not None:
            d = boxminus(result.motion.T, invert_transform(before.truth) @ scan.truth)
            run.nees.append(float(d @ np.linalg.solve(result.motion.covariance, d)) / 6.0)
    return Run(run.poses, run.nees, run.milliseconds, failed)


def gicp(scans: list[Scan]) -> Run:
    """Each frame to the one before, from the motion before; ImportError without small_gicp."""
    import small_gicp as library

    poses, motion, milliseconds = [np.eye(4)], np.eye(4), []
    clouds = [scan.cloud() for scan in scans]
    for target, source in pairwise(clouds):
        began = time.thread_time()
        result = library.align(
            target, source, init_T_target_source=motion, registration_type="GICP", downsampling_resolution=0.03,
            max_correspondence_distance=0.2, num_threads=1,
        )  # fmt: skip
        milliseconds.append(1e3 * (time.thread_time() - began))
        motion = np.asarray(result.T_target_source)
        poses.append(poses[-1] @ motion)
    return Run(poses, [], milliseconds, 0)


def kiss_icp(scans: list[Scan], min_motion: float = 0.1) -> Run:
    """Each frame to the map of those before; ImportError without kiss-icp."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew, config.data.min_range, config.data.max_range = False, NEAREST, FARTHEST
    config.mapping.voxel_size = FARTHEST / 100.0
    config.adaptive_threshold.min_motion_th = min_motion
    config.registration.max_num_threads = 1
    odometry, run = KissICP(config), Run([], [], [], 0)
    for scan in scans:
        cloud = scan.cloud()
        began = time.thread_time()
        odometry.register_frame(cloud, np.empty(0))
        run.milliseconds.append(1e3 * (time.thread_time() - began))
        run.poses.append(odometry.last_pose.copy())
    return run


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(name: str, method: str, scans: list[Scan], run: Run) -> str:
    world = [scans[0].truth @ T for T in run.poses]
    truths = [scan.truth for scan in scans]
    path = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(truths))
    errors = np.array([boxminus(T, G) for T, G in zip(world, truths, strict=True)])
    fit = umeyama(np.array([T[:3, 3] for T in world]), np.array([G[:3, 3] for G in truths]))
    apart = np.array([(fit @ T)[:3, 3] - G[:3, 3] for T, G in zip(world, truths, strict=True)])
    steps = np.array(
        [
            boxminus(invert_transform(a) @ b, invert_transform(g) @ h)
            for (a, b), (g, h) in zip(pairwise(world), pairwise(truths), strict=True)
        ]
    )
    drift, turn = 100 * np.linalg.norm(errors[-1, :3]) / path, np.rad2deg(np.linalg.norm(errors[-1, 3:]))
    step, step_turn = (rms(np.linalg.norm(half, axis=1)) for half in (steps[:, :3], steps[:, 3:]))
    nees = (
        f"{np.median(run.nees):6.2f} {np.mean(run.nees):5.2f} {np.percentile(run.nees, 99):5.1f}" if run.nees else "-"
    )
    ms = run.milliseconds[1:]
    return (
        f"{name:18s} {method:9s} {run.failed:6d} {1e3 * rms(np.linalg.norm(apart, axis=1)):7.1f} {drift:8.2f} "
        f"{turn:8.2f} {1e3 * np.abs(errors[:, 2]).max():10.1f} {1e3 * step:8.2f} {np.rad2deg(step_turn):6.3f}  "
        f"      {nees:>18s}  {np.median(ms):.1f} ({np.percentile(ms, 95):.1f})"
    )


def direct(scans: list[Scan]) -> None:
    """Distant frames registered directly from the true pose: how far the methods go from it."""
    for target, source in DISTANT:
        truth = invert_transform(scans[target].truth) @ scans[source].truth
        for method in ("ndt", "icp_plane"):
            config = RegistrationConfig(method=method)
            T = register(scans[source].points, scans[target].points, truth, config).T_target_source
            d = boxminus(T, truth)
            moved, turned = 1e3 * np.linalg.norm(d[:3]), np.rad2deg(np.linalg.norm(d[3:]))
            print(f"frame {source:3d} to {target}: {method:9s} {moved:5.1f} mm, {turned:.2f} deg from the truth")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bags", type=Path, nargs="*", default=[])
    parser.add_argument("--redkitchen", type=Path, help="folder of frame-*.depth.png and frame-*.pose.txt")
    parser.add_argument("--set", nargs="*", default=[], help="odometry parameters, name=value")
    arguments = parser.parse_args()
    values = {name: float(v) if "." in v else int(v) for name, v in (item.split("=") for item in arguments.set)}
    config = from_mapping(OdometryConfig, values)
    methods: dict[str, Callable[[list[Scan]], Run]] = {"ours": lambda scans: ours(scans, config), "GICP": gicp}
    methods |= {"KISS-ICP": kiss_icp, "KISS 1 cm": lambda scans: kiss_icp(scans, 0.01)}
    sequences = {bag.stem: scans_of_bag(bag) for bag in arguments.bags}
    if arguments.redkitchen is not None:
        sequences["redkitchen"] = scans_of_redkitchen(arguments.redkitchen)
    print(HEADINGS)
    for name, scans in sequences.items():
        for method, run in methods.items():
            try:
                print(row(name, method, scans, run(scans)), flush=True)
            except ImportError as error:
                print(f"without {method}: {error}")
    if "redkitchen" in sequences:
        direct(sequences["redkitchen"])


if __name__ == "__main__":
    main()
