# SPDX-License-Identifier: Apache-2.0
"""What the last optimisation of a map may cost: the memory of its joining problem is bounded, a small map uses all."""

from __future__ import annotations

import numpy as np
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.smoothing.solver import SmootherConfig, optimize_full, simplified


def test_a_map_settles_within_the_work_that_is_given(rng: np.random.Generator) -> None:
    agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.95), rng, "a")
    joined, _ = join(agent.submaps()[:12])
    entries = {}
    for work in (3e4, 1e9):
        config = SmootherConfig(settled_work=work)
        problem = optimize_full(simplified(joined.state, config), config).problem(0)
        entries[work] = len(problem.maps.information)
    assert entries[3e4] < 3e4 < entries[1e9]
