# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from slam_core.health import Health, State


def test_rate_and_latency_are_of_the_last_period_counters_of_all() -> None:
    health = Health()
    health.report(10.0)
    for duration in (0.010, 0.028):
        health.processed(duration)
    health.processed(0.002, is_frame=False)  # of an IMU
    health.count("rejected")
    health.set(State.DEGRADED, "few features")
    first = health.report(11.0)
    assert (first["rate_hz"], first["latency_mean_ms"], first["latency_max_ms"]) == ("2.00", "20.00", "28.00")
    assert (first["state"], first["reason"], first["rejected"]) == ("DEGRADED", "few features", "1")
    second = health.report(12.0)
    assert second["rate_hz"] == "0.00"
    assert "latency_mean_ms" not in second
    assert second["processed"] == "3"


def test_values_of_the_newest_input_are_reported() -> None:
    health = Health()
    health.show("score", 0.5)
    health.show("score", "0.7")
    assert health.report(1.0)["score"] == "0.7"
