# SPDX-License-Identifier: Apache-2.0
"""Every form and library that can be chosen: the map is the same whatever solves it, and the report says what did."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from judging import ate, chain_error, errors, join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.loop_closure.association import METHODS, AssociationConfig
from sjsam_node.loop_closure.verification import ClosureConfig
from sjsam_node.smoothing.solver import EstimatorConfig, SmootherConfig
from slam_core.linear_algebra.sparse_cholesky import BACKENDS

LIBRARIES = [name for name in BACKENDS if name != "auto"]
ROWS = ("joint", "block")


def joined_with(agent: Agent, estimator: EstimatorConfig, method: str = "joint") -> tuple[GlobalMap, list[JoinReport]]:
    config = GlobalMapConfig(
        smoothing=SmootherConfig(estimator=estimator),
        closure=ClosureConfig(association=AssociationConfig(method=method)),
    )
    joined, reports = join(agent.submaps(), GlobalMap(config))
    joined.settle()
    return joined, reports


def lap(seed: int) -> Agent:
    rng = np.random.default_rng(seed)
    return Agent(ring_world(3.0, rng, 12.0), circle(3.0, 1.25), rng)


@cache
def reference(rows: str) -> np.ndarray:
    joined, _ = joined_with(lap(1), EstimatorConfig(rows=rows))
    return np.array([p.T for p in joined.trajectory("a")])


@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("library", LIBRARIES)
def test_a_map_is_the_same_with_every_library(library: str, rows: str) -> None:
    joined, reports = joined_with(lap(1), EstimatorConfig(rows=rows, solver=library))
    assert any(r.closures for r in reports)
    assert {r.solver for r in reports} == {library}
    assert np.allclose([p.T for p in joined.trajectory("a")], reference(rows), atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_algorithm_4_as_written_closes_a_loop(method: str) -> None:
    agent = lap(2)
    joined, reports = joined_with(agent, EstimatorConfig(rows="block", iterations=1), method)
    assert max(r.iterations for r in reports) == 1
    assert any(r.closures for r in reports)
    assert ate(errors(joined, agent)[0]) < 0.5 * chain_error(lap(2), lap(2).submaps())
