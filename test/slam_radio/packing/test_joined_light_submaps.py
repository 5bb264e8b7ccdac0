# SPDX-License-Identifier: Apache-2.0
"""Submaps for the air join as whole ones do: a loop closes, and rooms that look alike stay apart."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "sjsam_node"))  # judging, submap_world

from judging import ate, errors, join
from submap_world import Agent, Sensor, World, circle, path_through, ring_world, room

from slam_core.types import Submap
from slam_radio.packing.light_submap import LightConfig, pack, unpack


def sent(submaps: list[Submap]) -> list[Submap]:
    """Submaps as a post receives them, with two of three of their landmarks."""
    return [unpack(pack(s, LightConfig(landmarks=2 * len(s.landmarks) // 3))) for s in submaps]


def test_a_loop_closes(rng: np.random.Generator) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.25), rng, "a")
    submaps = agent.submaps()
    _, whole = join(submaps)
    joined, light = join(sent(submaps))
    assert sum(len(r.closures) for r in whole) > 0
    assert sum(len(r.closures) for r in light) > 0
    assert ate(errors(joined, agent)[0]) < 0.1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_rooms_that_look_alike_are_not_joined(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = room((0.0, 0.0), (4.0, 4.0), 90, rng)
    corridor = np.stack([rng.uniform(2, 12, 120), rng.choice([-1.2, 1.2], 120), rng.uniform(-1, 1.5, 120)], axis=1)
    world = World.random(np.concatenate([first, first + np.array([14.0, 0.0, 0.0]), corridor]), rng)
    world.descriptors[90:180] = world.descriptors[:90]
    walk = [(-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (13.0, 0.0), (13.0, -1.0), (15.0, -1.0), (15.0, 1.0), (13.0, 1.0)]
    agent = Agent(world, path_through(walk), rng, "a", Sensor(max_range=3.5))
    joined, _ = join(sent(agent.submaps()))
    positions = joined.landmarks().positions[:, 0]
    assert (positions < 5.0).sum() > 20
    assert (positions > 9.0).sum() > 20
    assert ate(errors(joined, agent)[0]) < 0.5
