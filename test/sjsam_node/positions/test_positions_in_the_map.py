# SPDX-License-Identifier: Apache-2.0
"""Positions in a fixed frame: they bound the drift of a long way, honestly, and outliers tie nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from judging import errors
from submap_world import Agent, Sensor, World, path_through, room

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.positions.position_queue import PositionConfig
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, transform_points
from slam_core.types import PositionReading, Submap

ARM = np.array([0.1, -0.2, 0.5])
SIGMA = 0.1
T_BUILDING_WORLD = boxplus(np.eye(4), np.array([120.0, -45.0, 8.0, 0.02, -0.03, 2.1]))
CONFIG = GlobalMapConfig(position=PositionConfig(lever_arm=tuple(ARM.tolist())))


def drive(seed: int) -> Agent:
    """A way of 60 m through rooms, that comes back nowhere."""
    rng = np.random.default_rng(seed)
    corners = [(0.0, 0.0), (20.0, 0.0), (20.0, 15.0), (40.0, 15.0), (40.0, 20.0)]
    points = [room((x, y), (8.0, 8.0), 150, rng) for x, y in [*corners, (10.0, 0.0), (20.0, 8.0), (30.0, 15.0)]]
    world = World.random(np.concatenate(points), rng)
    sensor = Sensor(6.0, sigma_bearing=0.006, sigma_depth=0.01, odometry=(0.04, 0.01), max_landmarks=15)
    return Agent(world, path_through(corners), rng, "a", sensor, steps=8)


def positions(agent: Agent, seed: int, every: int = 2, outliers: float = 0.0) -> tuple[list[PositionReading], int]:
    """Readings along the true way, and how many of them are 5 m off."""
    rng, out, bad = np.random.default_rng([seed, 9]), [], 0
    for k in range(every, len(agent.path), every):
        place = transform_points(T_BUILDING_WORLD @ agent.path[k], ARM[None])[0] + SIGMA * rng.normal(size=3)
        if rng.random() < outliers:
            place, bad = place + 5.0 * unit(rng.normal(size=3)), bad + 1
        out.append(PositionReading(agent.stamp_ns + int(k * 1e8), place, SIGMA**2 * np.eye(3)))
    return out, bad


def unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))


def joined(submaps: Sequence[Submap], readings: Sequence[PositionReading] = ()) -> GlobalMap:
    out = GlobalMap(CONFIG)
    for s in submaps:
        out.add(s, [r for r in readings if s.start_stamp_ns < r.stamp_ns <= s.end_stamp_ns])
    return out


def ate(joined: GlobalMap, agent: Agent) -> float:
    """Of all poses, aligned to the truth."""
    found = joined.trajectory("a")
    places = np.array([p.T[:3, 3] for p in found])
    truth = np.array([agent.path[round((p.stamp_ns - agent.stamp_ns) / 1e8)][:3, 3] for p in found])
    return float(np.sqrt(np.mean(np.sum((transform_points(umeyama(places, truth), places) - truth) ** 2, axis=1))))


def test_positions_bound_the_drift_of_a_long_way_honestly() -> None:
    without, with_them, nees, frame = [], [], [], []
    for seed in range(4):
        agent = drive(seed)
        submaps = agent.submaps()
        plain, known = joined(submaps), joined(submaps, positions(agent, seed)[0])
        known.settle()
        with_them.append(ate(known, agent))
        without.append(ate(plain, agent))
        nees.append(errors(known, agent)[1].mean() / 6.0)
        found = known.snapshot().fixed_frame()
        assert found is not None
        T_true = invert_transform(agent.path[0]) @ invert_transform(T_BUILDING_WORLD)
        d = boxminus(T_true, found.T)
        frame.append(d @ np.linalg.solve(found.covariance, d) / 6.0)
    print(np.round(without, 3), np.round(with_them, 3), np.round(nees, 2), np.round(frame, 2))
    assert np.mean(with_them) < 0.5 * np.mean(without)
    assert 0.6 < np.mean(nees) < 1.5
    assert np.mean(frame) < 2.0
