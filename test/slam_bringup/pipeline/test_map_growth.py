# SPDX-License-Identifier: Apache-2.0
"""What a run tells of submaps whose place in the map nothing knows."""

from __future__ import annotations

import numpy as np
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMapConfig
from slam_bringup.pipeline.map_growth import map_growth


def events(agents: list[Agent]) -> list[str]:
    growth = map_growth(GlobalMapConfig())
    for agent in agents:
        for submap in agent.submaps():
            growth.add(submap)
    return growth.finish()


def test_agents_that_never_meet_are_told(rng: np.random.Generator) -> None:
    apart = [Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, name) for name in "ab"]
    told = events(apart)
    assert len(told) == 1
    assert "submaps of b are not tied to the rest of the map" in told[0]


def test_one_agent_alone_is_tied(rng: np.random.Generator) -> None:
    assert events([Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "a")]) == []
