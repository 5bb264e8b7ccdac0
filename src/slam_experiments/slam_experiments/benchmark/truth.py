# SPDX-License-Identifier: Apache-2.0
"""Errors of ground truth and calibration, which add to those of an estimate."""

from __future__ import annotations

import numpy as np

from slam_core.estimation.calibration_error import CalibrationErrorConfig, widened_by_calibration
from slam_core.evaluation import TruthAccuracy
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate

TRUTH = {
    # OXTS RT3003 with RTK corrections: Geiger et al. 2013 (IJRR), section on the sensor setup.
    "kitti": TruthAccuracy(position=0.02, rotation=float(np.radians(0.1))),
    # Vicon: Burri et al. 2016 (IJRR), positions to about 1 mm. The orientation is what ``ground_truth.py`` measures:
    # 3.1 mrad a step between two poses, in three axes.
    "euroc": TruthAccuracy(position=0.001, rotation=float(np.radians(0.08))),
    # The headset's own tracking: "good to centimetres" as its publishers say; 2 cm is the mark's.
    "hololens": TruthAccuracy(position=0.02),
    # KinectFusion, whose poses of 7-Scenes have no published accuracy. 4 cm between frames more than a second apart,
    # hence 4 / sqrt(2) cm each: its depth registered directly over 50 to 199 frames disagrees by as much
    # (``../registration/odometry.py``). Frames of the first second, which are better, count as the others.
    "redkitchen": TruthAccuracy(position=0.04 / float(np.sqrt(2.0))),
}
"""Of ground truth as its makers say, or as measured."""

CALIBRATION = CalibrationErrorConfig(sigma_scale=0.005, sigma_mounting=float(np.radians(0.3)))
"""By as much as calibrations of one camera differ; the frame of the ground truth is another's."""


def with_calibration_error(trajectory: Trajectory) -> Trajectory:
    """A trajectory with covariances that know of the calibration's error, the same in all poses of a run."""
    if trajectory.covariances is None:
        raise ValueError("a trajectory without covariances has none to widen")
    poses = zip(trajectory.stamps_ns, trajectory.poses, trajectory.covariances, strict=True)
    return Trajectory.from_estimates(
        [widened_by_calibration(PoseEstimate(int(s), T, C), CALIBRATION) for s, T, C in poses]
    )
