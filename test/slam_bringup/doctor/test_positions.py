# SPDX-License-Identifier: Apache-2.0
"""What is said of a recording's positions: covariances, the distance from their origin, and their spread."""

from __future__ import annotations

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.positions import check_positions
from slam_core.frame_tree import FrameTree
from slam_core.messages import position_from_message, position_message
from slam_core.types import PositionReading

CORNER = [(float(min(k, 20)), float(max(k - 20, 0)), 1.0) for k in range(40)]


def findings(places: list[tuple[float, ...]], sigma: float = 0.1) -> list[str]:
    rng = np.random.default_rng(1)
    sent = [
        PositionReading(k * 10**9, np.array(p) + sigma * rng.normal(size=3), sigma**2 * np.eye(3))
        for k, p in enumerate(places)
    ]
    readings = [position_from_message(position_message(BagTypes(), "uwb", reading)) for reading in sent]
    evidence = Evidence("", {"position": "/uwb"}, {}, {}, FrameTree(), "base_link", positions=readings)
    found = list(check_positions(evidence))
    assert all(finding.advice and "/uwb" in finding.what for finding in found)
    return [finding.check for finding in found]


def test_positions_around_a_corner_are_well_and_none_are_too() -> None:
    assert findings(CORNER) == []
    assert findings([]) == []


@pytest.mark.parametrize(
    ("places", "sigma", "check"),
    [
        (CORNER, 0.0, "position covariance"),
        (CORNER, 200.0, "position covariance"),
        ([(x + 5e5, y + 5e6, z) for x, y, z in CORNER], 0.1, "position frame"),
        ([(0.5 * k, 0.0, 1.0) for k in range(40)], 0.1, "position spread"),
        (CORNER[:4], 0.1, "position spread"),
    ],
)
def test_what_positions_lack_is_told(places: list[tuple[float, ...]], sigma: float, check: str) -> None:
    assert check in findings(places, sigma)


def test_a_position_that_is_not_finite_is_no_position() -> None:
    reading = PositionReading(1, np.array([1.0, np.inf, 0.0]), np.eye(3))
    with pytest.raises(ValueError, match="not finite"):
        position_from_message(position_message(BagTypes(), "uwb", reading))
