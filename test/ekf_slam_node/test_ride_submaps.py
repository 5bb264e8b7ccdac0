# SPDX-License-Identifier: Apache-2.0
"""Submaps around a ride: heights at which they end, whatever becomes of the ride."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from ekf_slam_node.odometry.cabin import Ride
from ekf_slam_node.odometry.ride_filter import HeightAt
from ekf_slam_node.ride_submaps import RideSubmaps
from slam_core.types import Counters

RIDE = Ride(0, 9_000_000_000, 9.0, 0.02, (HeightAt(4_000_000_000, 3.0, 0.01), HeightAt(9_000_000_000, 9.0, 0.02)))


@dataclass
class Chain:
    """Heights by which submaps ended, of a chain that is open."""

    is_open: bool = True
    is_empty: bool = False
    is_held_open: bool = False
    ends: list[tuple[float, float]] = field(default_factory=list)
    raised: list[float] = field(default_factory=list)

    def raise_path(self, heights: tuple[HeightAt, ...], up: object) -> None:
        self.raised += [at.height for at in heights]

    def displace(self, height: float, variance: float, up: object) -> None:
        self.ends.append((height, variance))

    def close(self) -> tuple[str, ...]:
        return ("submap",)

    def follow(self, *_: object) -> None:
        pass


@pytest.fixture
def riding() -> RideSubmaps:
    """A cabin that had risen by half a metre when the ride was found."""
    concluded = iter([RIDE])
    rides = SimpleNamespace(
        begun=(HeightAt(1, 0.2, 0.001),), height=HeightAt(2, 0.5, 0.004), is_riding=True, pressure_refused=2,
        ended=None, conclude=lambda: next(concluded, None),
    )  # fmt: skip
    inertial = SimpleNamespace(up=np.array([0.0, 0.0, 1.0]), tilt_covariance=1e-6 * np.eye(3))
    made = RideSubmaps(Chain(), SimpleNamespace(rides=rides, inertial=inertial, up=None), Counters())  # type: ignore[arg-type]
    made._begin(None)  # type: ignore[arg-type]
    return made


def test_both_submaps_of_a_ride_share_its_height(riding: RideSubmaps) -> None:
    submaps = riding._end(None, RIDE)  # type: ignore[arg-type]
    assert len(submaps) == 1
    assert riding.chain.ends == [(0.5, 0.004), (8.5, 0.02)]  # type: ignore[attr-defined]
    assert riding.chain.raised == [0.2, 2.5, 8.5]  # type: ignore[attr-defined]
    assert riding.finding == "lift rides: +9.00 +- 0.14 m in 9.0 s"
    assert riding.counters.counts == {"lift_rides": 1, "pressure_contradicted": 2}


def test_a_ride_that_is_retracted_ends_where_it_began(riding: RideSubmaps) -> None:
    riding._end(None, None)  # type: ignore[arg-type]
    assert riding.chain.ends == [(0.5, 0.004), (-0.5, 0.004)]  # type: ignore[attr-defined]
    assert riding.counters.counts == {"lift_rides": 1, "lift_rides_retracted": 1}
    assert riding.spans == []


def test_a_session_that_ends_as_the_cabin_stops_has_the_ride_once(riding: RideSubmaps) -> None:
    riding.chain.is_held_open = True
    riding.end_early()
    assert riding.chain.ends[1:] == [(8.5, 0.02)]  # type: ignore[attr-defined]
    assert riding.spans == [(0, 9_000_000_000)]
    assert not riding.chain.is_held_open


def test_a_ride_is_told_though_the_submap_was_given_up(riding: RideSubmaps) -> None:
    riding.chain.is_held_open = True
    riding.aids.rides.ended = RIDE
    riding.after_failure()
    assert riding.chain.ends == [(0.5, 0.004)]  # type: ignore[attr-defined]
    assert riding.spans == [(0, 9_000_000_000)]
    assert riding.begun is None
    assert not riding.chain.is_held_open
