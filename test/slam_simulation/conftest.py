# SPDX-License-Identifier: Apache-2.0
"""One furnished room, compiled once for all tests of the simulation."""

from __future__ import annotations

import pytest

from slam_simulation import Scenario, Simulator

ROOM = {
    "seed": 3,
    "rate": 4.0,
    "frames": 41,
    "rooms": [{"name": "office", "x": [0, 5], "y": [0, 4], "style": "office"}],
    "doorways": [{"at": [4.0, 0.0], "width": 0.9}],
    "objects": [{"kind": "table", "at": [2.5, 2.0], "size": [0.9, 0.6]}],
    "agents": [
        {"motion": "handheld", "height": 1.3, "path": [[1.2, 1.2, 0], [2.2, 1.1, 20], [3.0, 1.4, 60], [1.2, 1.2, 0]]}
    ],
}


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return Scenario.from_mapping("room", ROOM)


@pytest.fixture(scope="session")
def simulator(scenario: Scenario) -> Simulator:
    return Simulator(scenario, threads=1, truth=True)
