# SPDX-License-Identifier: Apache-2.0
"""What is said of a recording's barometer: unit, rate and noise."""

from __future__ import annotations

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.pressure import check_pressure
from slam_core.frame_tree import FrameTree
from slam_core.messages import pressure_from_message, pressure_message
from slam_core.types import PressureReading


def findings(pascal: float = 1e5, hz: float = 10.0, noise: float = 1.5, claimed: float = 1.5) -> list[str]:
    rng = np.random.default_rng(1)
    sent = [
        PressureReading(round(k * 1e9 / hz), pascal + noise * rng.standard_normal(), claimed**2) for k in range(100)
    ]
    readings = [pressure_from_message(pressure_message(BagTypes(), "base_link", reading)) for reading in sent]
    assert [(r.stamp_ns, r.pressure) for r in readings] == [(r.stamp_ns, r.pressure) for r in sent]
    evidence = Evidence("", {"pressure": "/baro"}, {}, {}, FrameTree(), "base_link", pressures=readings)
    found = list(check_pressure(evidence))
    assert all(finding.advice and "/baro" in finding.what for finding in found)
    return [finding.check for finding in found]


def test_a_good_barometer_and_none_are_well() -> None:
    assert findings() == []
    assert findings(claimed=0.0, noise=8.0) == []
    assert list(check_pressure(Evidence("", {}, {}, {}, FrameTree(), "base_link"))) == []


@pytest.mark.parametrize(
    ("values", "check"),
    [
        ({"pascal": 1013.0}, "pressure unit"),
        ({"hz": 1.0}, "pressure rate"),
        ({"noise": 8.0}, "pressure variance"),
    ],
)
def test_what_a_barometer_lacks_is_told(values: dict[str, float], check: str) -> None:
    assert findings(**values) == [check]


def test_a_pressure_that_is_no_number_is_refused() -> None:
    message = pressure_message(BagTypes(), "base_link", PressureReading(0, float("nan"), 1.0))
    with pytest.raises(ValueError, match="not finite"):
        pressure_from_message(message)
