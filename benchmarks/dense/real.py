# SPDX-License-Identifier: Apache-2.0
"""The dense model of a finished run against the model of the same recording on its true poses.

    python benchmarks/dense/real.py BAG OUT

BAG is a recording with ground truth, OUT the folder of its run. The trajectory is aligned to the truth by positions and
attitudes: positions alone leave the attitude of a short way open. This says what the poses cost; what the camera itself
gets wrong is in both models.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from dense_mapping.reconstruction.surface import Surface
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_run import dense_model
from slam_core.evaluation import associate
from slam_core.geometry import FloatArray, make_transform
from slam_core.trajectory import Trajectory, read_trajectory

NEAR_M = 3.0
HEADINGS = ("bag", "points", "median mm", "95 % mm", "beyond 10 cm %", "claimed sigma mm")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("run", type=Path)
    arguments = parser.parse_args()
    table = Table(*HEADINGS, title="dense model on estimated poses, against that on true poses")
    with SensorBag(arguments.bag) as bag:
        truth = bag.ground_truth(bag.agents[0])
        assert truth is not None, "the bag has no ground truth"
        matched, true_poses = associate(read_trajectory(arguments.run / "trajectory.tum"), truth)
        estimate = Trajectory(matched.stamps_ns, aligned(matched.poses, true_poses))
        true = Trajectory(matched.stamps_ns, true_poses)
        surfaces, centres = zip(*(model_on(bag, t) for t in (estimate, true)), strict=True)
    near = cKDTree(centres[0]).query(surfaces[0].points)[0] <= NEAR_M
    distance = 1000 * cKDTree(surfaces[1].points).query(surfaces[0].points[near])[0]
    table.add_row(
        arguments.bag.name,
        str(int(near.sum())),
        f"{np.median(distance):.1f}",
        f"{np.percentile(distance, 95):.1f}",
        f"{100 * np.mean(distance > 100):.2f}",
        f"{1000 * np.median(surfaces[0].sigma[near]):.1f}",
    )
    Console(width=140).print(table)


def aligned(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) turned by the mean difference of attitudes, then shifted by that of positions."""
    U, _, Vt = np.linalg.svd((truth[:, :3, :3] @ estimate[:, :3, :3].transpose(0, 2, 1)).sum(axis=0))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    shift = (truth[:, :3, 3] - estimate[:, :3, 3] @ R.T).mean(axis=0)
    return np.asarray(make_transform(R, shift) @ estimate)


def model_on(bag: SensorBag, trajectory: Trajectory) -> tuple[Surface, np.ndarray]:
    """The surface of the first agent on a trajectory, and its cameras' places (n, 3)."""
    stage = dense_model(bag, SystemConfig(), {bag.agents[0]: trajectory})
    return stage.surface(), np.array([k.T_map_camera[:3, 3] for k in stage.model.keyframes])


if __name__ == "__main__":
    main()
