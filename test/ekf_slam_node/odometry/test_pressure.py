# SPDX-License-Identifier: Apache-2.0
"""Heights by a barometer: differences from a ride's start, and readings that cannot be meant."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig, RideConfig
from ekf_slam_node.odometry.pressure import PressureHeights
from ekf_slam_node.slam import EkfSlam
from slam_core.types import PressureReading

STEP_NS = 100_000_000


def filled(sigma_pa: float = 0.0) -> PressureHeights:
    """At 0.9 bar, after half a second 2 m higher, after two seconds 6 m above that."""
    heights = PressureHeights(RideConfig())
    for k in range(40):
        pascal = 9e4 * np.exp(-(2.0 * (k >= 5) + 6.0 * (k >= 20)) / 8434.0)
        assert heights.add(PressureReading(k * STEP_NS, pascal, sigma_pa**2)) == ""
    return heights


def test_heights_are_above_the_ride_s_start() -> None:
    heights = filled(sigma_pa=2.0)
    sigma = heights.start(19 * STEP_NS)
    assert sigma == pytest.approx(2.0 * 8434.0 / 9e4 / 2.0, rel=0.01)  # a mean of which four count
    told = heights.since(19 * STEP_NS, 30 * STEP_NS)
    assert told is not None
    assert told[0] == pytest.approx(6.0, abs=1e-9)
    assert told[1] == pytest.approx((2.0 * 8434.0 / 9e4) ** 2, rel=0.01)


def test_noise_that_is_not_claimed_is_the_parameter_s() -> None:
    heights = filled()
    heights.start(19 * STEP_NS)
    told = heights.since(19 * STEP_NS, 25 * STEP_NS)
    assert told is not None
    assert told[1] == pytest.approx(0.3**2)


def test_without_a_reading_nearby_nothing_is_told() -> None:
    heights = filled()
    assert heights.since(0, STEP_NS) is None, "no ride has begun"
    heights.start(19 * STEP_NS)
    assert heights.since(19 * STEP_NS, 50 * STEP_NS) is None
    heights.start(90 * STEP_NS)
    assert heights.since(90 * STEP_NS, 91 * STEP_NS) is None, "nothing was read before that start"


def test_a_reading_is_measured_once() -> None:
    heights = filled()
    heights.start(19 * STEP_NS)
    assert heights.since(19 * STEP_NS, 30 * STEP_NS) is not None
    assert heights.since(19 * STEP_NS, 30 * STEP_NS + 1) is None
    assert heights.since(19 * STEP_NS, 31 * STEP_NS) is not None


@pytest.mark.parametrize(
    ("pascal", "stamp_ns", "count"),
    [
        (1013.0, 2, "pressure_of_no_air"),
        (float("nan"), 2, "pressure_of_no_air"),
        (1e5, 1, "pressure_not_newer"),
    ],
)
def test_readings_that_cannot_be_meant_are_counted(pascal: float, stamp_ns: int, count: str) -> None:
    slam = EkfSlam(EkfSlamConfig())
    slam.process_pressure(PressureReading(1, 1e5))
    slam.process_pressure(PressureReading(stamp_ns, pascal))
    assert slam.counters.counts == {count: 1}
