# SPDX-License-Identifier: Apache-2.0
"""What a run tells of submaps whose place in the map nothing knows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from positioned_world import drive, positions
from submap_world import Agent, circle, ring_world

from sjsam_node.session.map_session import MapSession, Mode
from slam_bringup.pipeline.configuration import load_system_config
from slam_bringup.pipeline.mapper import Mapper
from slam_bringup.pipeline.run_record import RunRecord
from slam_bringup.pipeline.stage_times import StageTimes

SYSTEM = load_system_config(None)


def record(agents: list[Agent], session: MapSession) -> RunRecord:
    """The record of a run whose filters had no frames, and whose session got the submaps of some agents."""
    mapper = Mapper(SYSTEM, {}, StageTimes(), session)
    for agent in agents:
        mapper._hand_over(agent.submaps())
    mapper.finish()
    return mapper.record(0.0, {}, "")


def test_agents_that_never_meet_are_told(rng: np.random.Generator) -> None:
    apart = [Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, name) for name in "ab"]
    with MapSession(SYSTEM.sjsam) as session:
        told = record(apart, session).events
    assert len(told) == 1
    assert "submaps of b are not tied to the rest of the map" in told[0]


def test_one_agent_alone_is_tied(rng: np.random.Generator) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "a")
    with MapSession(SYSTEM.sjsam) as session:
        made = record([agent], session)
    assert made.events == ()
    assert made.submaps == made.backlog["received"] == len(agent.submaps())
    assert len(made.stage_ms["sjsam"]) == made.submaps


def test_poses_of_an_agent_that_is_located_begin_where_it_is_recognised(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.0), rng, "a")
    stranger = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "stranger")
    visitor = Agent(agent.world, agent.path[10:40], rng, "visitor")
    with MapSession(SYSTEM.sjsam) as session:
        record([agent], session)
        session.save(tmp_path / "map").result()
    with MapSession(SYSTEM.sjsam, Mode.LOCALISE) as session:
        session.load(tmp_path / "map", len).result()
        made = record([stranger, visitor], session)
    lost = len(stranger.submaps())
    count = lost + len(visitor.submaps())
    assert made.events == (f"{lost} of {count} submaps were not found in the map: their poses are left out",)
    assert list(made.trajectories) == ["visitor"]
    stamps = [pose.stamp_ns for pose in made.trajectories["visitor"]]
    assert stamps == sorted({pose.stamp_ns for submap in visitor.submaps() for pose in submap.path})
    assert made.loop_closures >= len(visitor.submaps()) // 2


def test_positions_of_a_run_that_nothing_ties_to_the_map_are_said_to_wait(tmp_path: Path) -> None:
    first, second = drive(1), drive(2)
    second.name, second.stamp_ns = "b", 10**12
    with MapSession(SYSTEM.sjsam) as session:
        assert "joined with the map, 0 refused" in heard(session, first, len(first.path))
        session.save(tmp_path / "map").result()
    with MapSession(SYSTEM.sjsam) as session:
        session.load(tmp_path / "map", lambda _: None).result()
        assert re.match(r"\d\d? positions wait", heard(session, second, 40))


def heard(session: MapSession, agent: Agent, steps: int) -> str:
    """What a run says of the positions on the first steps of a way."""
    mapper = Mapper(SYSTEM, {}, StageTimes(), session)
    mapper._has_positions = True
    for reading in positions(agent, 1)[0]:
        session.add_position(agent.name, reading)
    mapper._hand_over(agent.submaps()[: steps // agent.steps])
    mapper.finish()
    return next(said for said in mapper.record(0.0, {}, "").events if "positions" in said)
