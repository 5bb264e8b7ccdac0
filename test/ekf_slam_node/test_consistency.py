# SPDX-License-Identifier: Apache-2.0
"""Monte-Carlo through the whole estimator, association and submaps included: are its covariances true?

The full figures, with more runs and more cases, are printed by ``benchmarks/ekf/consistency.py``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from monte_carlo import Run, mean_nis, seam_nees, simulate

from ekf_slam_node.config import EkfSlamConfig
from feature_world import loop, wander
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


def test_innovations_of_a_smooth_rig_are_as_large_as_claimed(independent: list[Run]) -> None:
    value, low, high = mean_nis(independent, EkfSlamConfig().association.gate, own_motion=False)
    assert low < value < high


def test_innovations_of_a_rig_that_moves_as_the_model_says_are_as_large_as_claimed() -> None:
    """Also tells whether pairs were chosen for their small errors: then it falls below the bounds."""
    acceleration, first = np.repeat([0.5, 0.4], 3), np.repeat([0.3, 0.2], 3)
    motion = {
        "motion.sigma_acceleration": 0.5,
        "motion.sigma_angular_acceleration": 0.4,
        "motion.sigma_initial_velocity": 0.3,
        "motion.sigma_initial_turn_rate": 0.2,
        "submap.max_distance": 1e6,
    }
    config = from_mapping(EkfSlamConfig, motion)
    done = [simulate(seed, config, lambda rng: wander(26, 0.1, acceleration, first, rng, 3.0)) for seed in range(RUNS)]
    value, low, high = mean_nis(done, config.association.gate, own_motion=True)
    assert low < value < high


def test_independent_submaps_share_no_information_and_conditional_ones_do(independent: list[Run]) -> None:
    assert 0.93 < seams(independent) < 1.07
    assert seams(runs("conditional")) < 0.6
