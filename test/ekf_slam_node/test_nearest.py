# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours (thesis 4.2): both gates, the covariance that wrong pairs need, and the warning."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.association.association import associate_nearest, wrong_pair_variance
from ekf_slam_node.config import EkfSlamConfig, FeatureAssociationConfig
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.models import Frame, observe
from ekf_slam_node.filtering.noise_monitor import InnovationWatch
from ekf_slam_node.slam import EkfSlam
from feature_world import CAMERA, T_RIG_OPTICAL, loop, room
from slam_core.config import from_mapping

CONFIG = FeatureAssociationConfig(method="nearest", nearest_associate=0.1, nearest_new=0.3)


def _candidates(points: np.ndarray, landmarks: int) -> Candidates:
    n = len(points)
    return Candidates(points, np.zeros((n, 3, 3)), np.ones((n, 1), np.float32), np.zeros(n, np.int64), landmarks)


def _frame(points: np.ndarray) -> Frame:
    n, z = len(points), observe(np.eye(4), T_RIG_OPTICAL, points, CAMERA).z
    return Frame(0, z, np.full((n, 3), 1e-6), np.ones((n, 1), np.float32), CAMERA, np.arange(n), np.zeros(n, np.int64))


def test_between_the_gates_a_feature_is_neither_known_nor_new():
    seen = np.array([[3.0, 0.0, 0.0], [3.0, 0.5, 0.0], [3.0, -0.8, 0.0]])
    landmarks = seen[:2] + np.array([[0.0, 0.05, 0.0], [0.0, 0.2, 0.0]])
    candidates = _candidates(np.vstack([landmarks, seen + np.array([0.0, 0.01, 0.0])]), 2)
    rows, columns = associate_nearest(candidates, _frame(seen), np.eye(4), T_RIG_OPTICAL, CONFIG)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (4, 2)]


def test_more_candidates_within_the_gate_widen_the_covariance():
    seen = np.array([[2.0, 0.0, 0.0], [2.0, 0.6, 0.0]])
    candidates = _candidates(np.vstack([seen, seen[:1] + np.array([0.0, 0.0, 0.05])]), 3)
    wider = wrong_pair_variance(candidates, _frame(seen), np.eye(4), T_RIG_OPTICAL, CONFIG)
    assert wider[0, 0] == pytest.approx(0.5 * (0.1 * CAMERA.fx / 2.0) ** 2 / 5.0)
    assert not wider[1].any()


def test_the_gates_are_in_order():
    with pytest.raises(ValueError, match="nearest_new"):
        FeatureAssociationConfig(nearest_associate=0.3, nearest_new=0.2)


def test_innovations_that_stay_too_large_are_complained_of():
    watch = InnovationWatch()
    for ratio in (1.0, 5.0, 0.8, 5.0):
        watch.add(ratio)
    assert watch.diagnostic == ""
    watch.add(3.0)
    assert "4.3 times" in watch.diagnostic


@pytest.mark.parametrize("wrong", [False, True])
def test_the_filter_warns_where_its_pairs_are_wrong(wrong, rng):
    """Points that change places a little between frames, as wrong pairs do, and in the same world none that do."""
    slam = EkfSlam(from_mapping(EkfSlamConfig, {"association.method": "nearest"}))
    world = room(rng, 400)
    complaints = []
    for k, T in enumerate(loop(12, 10.0, 0.3, 0.05)):
        seen = world if not wrong else type(world)(
            world.points + 0.03 * rng.standard_normal(world.points.shape), world.descriptors
        )  # fmt: skip
        slam.process(seen.features(T, k * 100_000_000, rng)[0])
        complaints.append(slam.diagnostic)
    assert bool(complaints[-1]) == wrong
