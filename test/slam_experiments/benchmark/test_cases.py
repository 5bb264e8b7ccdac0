# SPDX-License-Identifier: Apache-2.0
"""Cases of the benchmark: what a kept result depends on."""

from __future__ import annotations

import pytest

from slam_experiments.benchmark.cases import cases_of
from slam_experiments.benchmark.recording_sets import RecordingSet
from slam_experiments.benchmark.variants import AS_IT_IS

CHANGED = ("bag/images/left.png", "bag/calibration.yaml", "rig/left.yaml", "truth.txt")


@pytest.mark.parametrize("changed", CHANGED)
def test_a_file_that_is_rewritten_makes_a_kept_result_stale(tmp_path, changed):
    for name in CHANGED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    more = {"calibration": tmp_path / "rig", "ground_truth": tmp_path / "truth.txt"}
    recording = RecordingSet("hall", "euroc", tmp_path / "bag", "stereo", ("alone",), "", **more)
    (before,) = cases_of(recording, [AS_IT_IS])
    (again,) = cases_of(recording, [AS_IT_IS])
    assert again.job.digest == before.job.digest
    (tmp_path / changed).write_text("behind")
    (after,) = cases_of(recording, [AS_IT_IS])
    assert after.job.digest != before.job.digest


def test_a_calibration_beside_a_single_file_makes_a_kept_result_stale(tmp_path):
    (tmp_path / "hall.mcap").write_text("bag")
    recording = RecordingSet("hall", "", tmp_path / "hall.mcap", "stereo", ("alone",), "")
    (before,) = cases_of(recording, [AS_IT_IS])
    (tmp_path / "hall.calibration.yaml").write_text("/**: {}")
    (after,) = cases_of(recording, [AS_IT_IS])
    assert after.job.digest != before.job.digest
