"""Monte-Carlo through the whole estimator, association and submaps included: are its covariances true?

The full figures, with more runs and more cases, are printed by ``benchmarks/ekf/consistency.py``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from feature_world import loop
from monte_carlo import Run, seam_nees, simulate

from ekf_slam_node.config import EkfSlamConfig
from slam_core.config import from_mapping
from slam_core.evaluation import anees_bounds
from slam_core.geometry import FloatArray

RUNS = 8


def handheld(rng: np.random.Generator) -> list[FloatArray]:
    return loop(26, 10.0, 1.5, 0.26, handheld=0.02)


def runs(start: str) -> list[Run]:
    config = from_mapping(EkfSlamConfig, {"submap.start": start})
    return [simulate(seed, config, handheld) for seed in range(RUNS)]


@pytest.fixture(scope="module")
def independent() -> list[Run]:
    return runs("independent")


def seams(done: list[Run]) -> float:
    values = [seam_nees(a.submap, b.submap) for run in done for a, b in pairwise(run.submaps)]
    assert len(values) >= RUNS
    return float(np.mean(values))


def test_end_poses_are_as_wrong_as_they_say(independent: list[Run]) -> None:
    low, high = anees_bounds(6, RUNS)
    for k in (0, 1):
        assert low < np.mean([run.submaps[k].pose_nees for run in independent]) / 6 < high


def test_submaps_are_as_wrong_as_they_say(independent: list[Run]) -> None:
    submaps = [submap for run in independent for submap in run.submaps]
    freedom = sum(len(submap.error) for submap in submaps)
    low, high = anees_bounds(1, freedom, 0.99)
    assert low < sum(s.joint_nees * len(s.error) for s in submaps) / freedom < high
    assert 0.9 < np.mean([s.landmark_nees for s in submaps]) / 3 < 1.1


def test_innovations_are_not_larger_than_claimed(independent: list[Run]) -> None:
    """Below one by what the gates cut off and by a rig that is smoother than its motion model."""
    assert 0.9 < np.mean([run.nis for run in independent]) < 1.01


def test_independent_submaps_share_no_information_and_conditional_ones_do(independent: list[Run]) -> None:
    assert 0.93 < seams(independent) < 1.07
    assert seams(runs("conditional")) < 0.6
