# SPDX-License-Identifier: Apache-2.0
"""A long way without a closure: what is far from the fixed end is as exact as what is near."""

from __future__ import annotations

import numpy as np
from judging import join
from submap_world import Agent, circle, ring_world


def test_covariances_of_all_poses_are_those_from_the_factor(rng: np.random.Generator) -> None:
    """Asymmetric rounding once grew by 1.8 with every submap: covariances far from the start were noise."""
    agent = Agent(ring_world(18.0, rng, 12.0), circle(18.0, 0.95), rng, "a")
    joined, _ = join(agent.submaps()[:100])
    joined.settle()
    assembled = joined.state.problem(0)
    marginals = assembled.problem.marginals(assembled.optimum)
    for node in range(1, len(assembled.nodes), 9):
        exact = assembled.problem.columns(assembled.optimum, np.array([node]))
        assert np.abs(marginals.covariance([node]) - exact).max() < 1e-9 * np.abs(exact).max()
    assert len(assembled.nodes) == 101
