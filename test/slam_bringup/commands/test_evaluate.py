# SPDX-License-Identifier: Apache-2.0
"""``slam evaluate``: the accuracy of ground truth reaches the NEES."""

from __future__ import annotations

import json

import numpy as np
import pytest

from slam_bringup.cli import slam
from slam_core.trajectory import Trajectory, write_covariance_csv, write_tum


def test_sigma_of_the_truth_lowers_the_anees(tmp_path):
    """Estimates that claim 1 mm and 1 mrad and are 10 mm off: NEES 100 of 6, or 100 / 201 with a truth of 10 mm."""
    stamps = np.arange(4, dtype=np.int64) * 10**9
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, 0, 3] = np.arange(4.0)
    off = truth.copy()
    off[1:, 0, 3] += 0.01
    write_tum(tmp_path / "truth.txt", Trajectory(stamps, truth))
    estimate = Trajectory(stamps, off, np.tile(1e-6 * np.eye(6), (4, 1, 1)))
    write_tum(tmp_path / "trajectory.tum", estimate)
    write_covariance_csv(tmp_path / "trajectory_covariance.csv", estimate)
    arguments = ["evaluate", str(tmp_path / "trajectory.tum"), str(tmp_path / "truth.txt"), "-o", str(tmp_path / "out")]
    for extra, expected in (((), 100.0), (("--truth-sigma", "0.01", "0"), 100.0 / 201.0)):
        slam([*arguments, *extra], standalone_mode=False)
        assert json.loads((tmp_path / "out").read_text())["anees"] == pytest.approx(expected / 6.0, rel=1e-6)
