# SPDX-License-Identifier: Apache-2.0
"""What false matches and look-alike places do to the joined map.

    python benchmarks/joining/false_closures.py

Table of ATE with a share of the landmarks carrying another one's descriptor and id, and of two rooms that look alike.
"""

from __future__ import annotations

import numpy as np
import problems  # noqa: F401 - sets the import path
from judging import ate, errors, join
from submap_world import Agent, Sensor, circle, path_through, ring_world
from test_global_map import building, spoil


def false_matches(seeds: int = 4) -> None:
    shares = (0.0, 0.05, 0.1, 0.2)
    rows = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.25), rng, "a")
        submaps = agent.submaps()
        rows.append([ate(errors(join(spoil(submaps, share, rng))[0], agent)[0]) for share in shares])
    print("share of false landmarks, ATE m (median of runs), ratio to none")
    for share, value in zip(shares, np.median(rows, axis=0), strict=True):
        print(f"  {share:5.0%}  {value:8.4f}  {value / np.median(rows, axis=0)[0]:6.2f}")


def look_alike_rooms(seeds: int = 4) -> None:
    print("two rooms that look alike: closures believed between them, ATE m")
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        world, walk = building(rng, alike=True)
        agent = Agent(world, path_through(walk), rng, "a", Sensor(max_range=3.5))
        joined, _ = join(agent.submaps())
        x = joined.state.poses[:, 0, 3]
        records = joined.estimate.graph.records
        # The rooms are 14 m apart: a link between them joins starts that are about as far apart.
        gaps = [abs(x[records[k.first].start] - x[records[k.second].start]) for k in joined.estimate.graph.links]
        false = sum(gap > 11.0 for gap in gaps)
        print(f"  seed {seed}: {false}  {ate(errors(joined, agent)[0]):.3f}")


if __name__ == "__main__":
    look_alike_rooms()
    false_matches()
