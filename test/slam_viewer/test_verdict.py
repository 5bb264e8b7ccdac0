# SPDX-License-Identifier: Apache-2.0
"""Runs that lost too much are told from those that did not, by limits that a user can set."""

from __future__ import annotations

from typing import Any

import pytest

from slam_bringup.pipeline.configuration import system_config
from slam_bringup.pipeline.overrides import overrides_of
from slam_viewer.verdict import RunConfig, faults_of_run

SUMMARY: dict[str, Any] = {"frames": 100, "lost_share": {"": 0.0}, "dropped_by_reason": {}}


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"lost_share": {"one": 0.1, "two": 0.92}}, "agent two lost in 92% of the frames"),
        ({"dropped_by_reason": {"late": 50, "unusable messages on /imu": 400}}, "82% of the messages not used"),
        ({"dropped_by_reason": {"late": 50, "unusable messages on /imu": 400}}, "unusable messages on /imu"),
        ({"localization": {"": {"located_share": 0.05, "first_located_s": 3.0}}}, "located in 5% of the frames"),
    ],
)
def test_each_kind_of_loss_is_named(changed: dict[str, Any], fault: str) -> None:
    assert fault in "; ".join(faults_of_run(SUMMARY | changed, RunConfig()))


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"lost_share": {"": 0.4}},
        {"dropped_by_reason": {"duplicate stamps on /left": 900, "late": 200}},
        {"localization": {"": {"located_share": 0.5, "first_located_s": 3.0}}},
    ],
)
def test_what_a_run_can_lose_is_no_fault(changed: dict[str, Any]) -> None:
    assert not faults_of_run(SUMMARY | changed, RunConfig())


def test_the_limits_are_parameters() -> None:
    limits = system_config(overrides_of({"run": {"max_lost_share": 0.05}}, "own.yaml")).run
    assert faults_of_run(SUMMARY | {"lost_share": {"": 0.1}}, limits)
