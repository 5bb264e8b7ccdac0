# SPDX-License-Identifier: Apache-2.0
"""The dense model against the true surfaces, on true poses or on estimated ones.

    python benchmarks/dense/accuracy.py BAG [BAG ...] [--camera tof|stereo|both] [--frames N] [--run OUT]

BAG is the bag of a simulated scenario and named like it. Counted are points of the model that some key frame's camera
saw from 3 m or less: distance to the nearest true surface, distance over claimed sigma (NEES, 1 if honest). Seen twice:
share of the true surface which two key frames saw from 3 m or less that has a point of the model within 5 cm. ``--run``
takes the trajectory of a finished run in OUT instead of the truth, aligned to it as a whole (SE3).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from dense_mapping.dense_model import DenseModel
from dense_mapping.reconstruction.surface import Surface
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_run import dense_model
from slam_core.evaluation import align, associate
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory, read_trajectory
from slam_simulation.rendering.surface_distance import count_sightings, distance_to_surfaces, sample_surfaces
from slam_simulation.scenario import Scenario
from slam_simulation.world.surface_table import compile_world

NEAR_M = 3.0
HEADINGS = (
    "bag", "camera", "key frames", "points", "median mm", "95 % mm", "beyond 10 cm %", "claimed sigma mm", "NEES",
    "seen twice %", "CPU s", "ms/key frame", "surface s", "MB of blocks",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG")
    parser.add_argument("--camera", choices=("tof", "stereo", "both"), action="append")
    parser.add_argument("--frames", type=int, default=0, help="only the first so many poses")
    parser.add_argument("--run", type=Path, help="folder of a finished run whose trajectory is used")
    arguments = parser.parse_args()
    table = Table(*HEADINGS, title="dense model against true surfaces within 3 m")
    for path in arguments.bags:
        for camera in arguments.camera or ("tof", "stereo", "both"):
            table.add_row(*row(path, camera, arguments.frames, arguments.run))
    Console(width=200).print(table)


def row(path: Path, camera: str, frames: int, run: Path | None) -> list[str]:
    """One model, measured."""
    scenario = Scenario.load(path.name)
    world = scenario.world()
    system = SystemConfig()
    system = replace(
        system, dense_mapper=replace(system.dense_mapper, use_tof=camera != "stereo", use_stereo=camera != "tof")
    )
    started = time.process_time()
    with SensorBag(path) as bag:
        trajectories = {agent: poses_of(bag, agent, frames, run) for agent in bag.agents}
        stage = dense_model(bag, system, trajectories)
    model = stage.model
    megabytes = (model.volume.voxels.nbytes + model.volume.colours.nbytes) / 2**20
    between = time.process_time()
    surface = stage.surface()
    ended = time.process_time()
    points = surface.points.astype(np.float64)
    near = nearest_camera(model, points) <= NEAR_M
    distance = distance_to_surfaces(world, points[near])
    nees = float(np.mean(np.square(distance / surface.sigma[near]))) if near.any() else np.nan
    quantiles = np.percentile(1000 * distance, [50, 95]) if near.any() else (np.nan, np.nan)
    return [
        path.name, camera, str(len(model.keyframes)), str(int(near.sum())),
        f"{quantiles[0]:.1f}", f"{quantiles[1]:.1f}",
        f"{100 * np.mean(distance > 0.1):.2f}", f"{1000 * np.median(surface.sigma[near]):.1f}", f"{nees:.2f}",

        f"{100 * completeness(scenario, model, surface):.1f}", f"{between - started:.1f}",
        f"{1000 * (between - started) / max(len(model.keyframes), 1):.0f}", f"{ended - between:.1f}",
        f"{megabytes:.0f}",
    ]  # fmt: skip


def poses_of(bag: SensorBag, agent: str, frames: int, run: Path | None) -> Trajectory:
    """True poses, or those of a finished run laid on the truth."""
    truth = bag.ground_truth(agent)
    assert truth is not None, "a simulated bag has ground truth"
    if run is not None:
        estimate = read_trajectory(run / (f"trajectory_{agent}.tum" if agent else "trajectory.tum"))
        matched, true_poses = associate(estimate, truth)
        truth = Trajectory(matched.stamps_ns, align(matched.poses, true_poses, "se3"))
    return truth.select(np.arange(min(frames or len(truth), len(truth))))


def nearest_camera(model: DenseModel, points: FloatArray) -> FloatArray:
    """Distance (n,) m of points to the nearest key frame's camera."""
    centres = np.array([k.T_map_camera[:3, 3] for k in model.keyframes])
    return np.asarray(cKDTree(centres).query(points)[0]) if len(centres) else np.full(len(points), np.inf)


def completeness(scenario: Scenario, model: DenseModel, surface: Surface) -> float:
    """Share of the true surface seen twice from near that has a point of the model within 5 cm."""
    world = scenario.world()
    points, normals = sample_surfaces(world, 0.05)
    table, seen = compile_world(world), np.zeros(len(points))
    for name in sorted({k.camera for k in model.keyframes}):
        frames = [k for k in model.keyframes if k.camera == name]
        poses = np.stack([k.T_map_camera for k in frames])
        seen += count_sightings(table, points, normals, frames[0].keyframe.camera, poses, NEAR_M)
    twice = points[seen >= 2]
    distance = cKDTree(surface.points).query(twice, distance_upper_bound=0.06)[0]
    return float(np.mean(distance <= 0.05))


if __name__ == "__main__":
    main()
