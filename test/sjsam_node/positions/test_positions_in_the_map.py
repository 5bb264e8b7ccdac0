# SPDX-License-Identifier: Apache-2.0
"""Positions in a fixed frame: they bound the drift of a long way, honestly, and outliers tie nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from judging import errors
from positioned_world import ARM, SIGMA, T_BUILDING_WORLD, drive, positions, unit
from submap_world import Agent

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.positions import position_links
from sjsam_node.positions.position_links import REFUSED, USED, readings_of
from sjsam_node.positions.position_queue import PositionConfig
from sjsam_node.positions.stored_readings import stored_waiting
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, boxminus, invert_transform, transform_points
from slam_core.types import PositionReading, Submap

CONFIG = GlobalMapConfig(position=PositionConfig(lever_arm=tuple(ARM.tolist())))


@pytest.fixture(scope="module")
def agent() -> Agent:
    return drive(1)


@pytest.fixture(scope="module")
def submaps(agent: Agent) -> list[Submap]:
    return agent.submaps()


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
        first = known.state.graph.records[int(np.nonzero(known.state.graph.is_position)[0][0])]
        at_map = known.snapshot().start(known.state.graph.records.index(first))
        T_map_world = invert_transform(agent.path[0])
        truth = T_map_world @ invert_transform(T_BUILDING_WORLD) @ invert_transform(first.submap.end_pose)
        d = boxminus(truth, at_map.T)
        frame.append(d @ np.linalg.solve(at_map.covariance, d) / 6.0)
    assert np.mean(with_them) < 0.3 * np.mean(without)
    # Poses of one run share their errors: each run's mean is a draw with a spread of about 0.4.
    assert 0.5 < np.mean(nees) < 1.5
    assert 0.2 < np.mean(frame) < 2.0


def test_outliers_are_refused_and_change_little(agent: Agent, submaps: list[Submap]) -> None:
    readings, bad = positions(agent, 3, outliers=0.1)
    known = joined(submaps, readings)
    assert bad > 5
    assert bad <= known.counters.counts[REFUSED] <= bad + 3
    assert known.counters.counts[USED] == len(used(known))
    known.settle()
    assert ate(known, agent) < 0.12
    assert max(np.abs(r.position - true_place(agent, r)).max() for r in used(known)) < 6 * SIGMA


@pytest.mark.parametrize(("sigma_z", "error_m"), [(2.0, 5.0), (SIGMA, 1.5)])
def test_outliers_beside_the_way_are_refused_whatever_the_height_says(sigma_z: float, error_m: float) -> None:
    agent, rng, bad, readings = drive(2), np.random.default_rng(2), set(), []
    for r in positions(agent, 2)[0]:
        place = r.position + np.array([0.0, 0.0, rng.normal() * (sigma_z if sigma_z > SIGMA else 0.0)])
        if rng.random() < 0.1:
            place[:2] += error_m * unit(rng.normal(size=2))
            bad.add(r.stamp_ns)
        readings.append(replace(r, position=place, covariance=np.diag([SIGMA, SIGMA, sigma_z]) ** 2))
    known = joined(agent.submaps(), readings)
    assert len(bad) > 8
    assert {r.stamp_ns for r in readings} - {r.stamp_ns for r in used(known)} == bad
    known.settle()
    assert ate(known, agent) < 0.25


@pytest.mark.parametrize(("error_m", "counted"), [(0.0, USED), (3.0, REFUSED)])
def test_far_from_the_first_position_the_drift_turns_the_rig_and_not_that_place(
    agent: Agent, submaps: list[Submap], error_m: float, counted: str
) -> None:
    readings = positions(agent, 1)[0]
    until = submaps[21].end_stamp_ns
    known = joined(submaps[:29], [r for r in readings if r.stamp_ns <= until])
    before = known.counters.counts.get(counted, 0)
    inside = next(r for r in readings if r.stamp_ns > submaps[29].start_stamp_ns)
    known.add(submaps[29], [replace(inside, position=inside.position + np.array([0.0, 0.0, error_m]))])
    assert known.counters.counts[counted] == before + 1


def used(known: GlobalMap) -> list[PositionReading]:
    return [r for record in known.state.graph.records if record.is_position for r in readings_of(record.submap)]


def true_place(agent: Agent, reading: PositionReading) -> FloatArray:
    k = round((reading.stamp_ns - agent.stamp_ns) / 1e8)
    return np.asarray(transform_points(T_BUILDING_WORLD @ agent.path[k], ARM[None])[0])


def test_along_a_line_positions_wait_and_change_nothing_that_can_be_seen(agent: Agent, submaps: list[Submap]) -> None:
    readings = [r for r in positions(agent, 1)[0] if r.stamp_ns < submaps[7].end_stamp_ns]
    plain, known = joined(submaps[:8]), joined(submaps[:8], readings)
    assert known.snapshot().fixed_frame() is None
    assert USED not in known.counters.counts
    assert np.abs(plain.state.poses - known.state.poses).max() < 1e-6
    assert len(plain.landmarks().ids) == len(known.landmarks().ids)


def test_positions_are_no_agent_and_no_landmarks(agent: Agent, submaps: list[Submap]) -> None:
    plain, known = joined(submaps), joined(submaps, positions(agent, 1)[0])
    shown = known.snapshot()
    assert set(known.trajectory()) == set(known.path()) == {"a"}
    assert shown.submap_count == len(submaps) < len(shown)
    assert len(shown.skeleton_lines()) == len(submaps)
    assert len(known.landmarks().ids) == len(plain.landmarks().ids)
    assert np.allclose(shown.newest_place, known.state.end(known.agents.newest("a") or 0)[:3, 3])
    refused = known.add(replace(submaps[0], agent="position/a"))
    assert "position/" in refused.reason


def test_a_map_with_positions_is_loaded_as_it_was_and_goes_on(
    agent: Agent, submaps: list[Submap], tmp_path: Path
) -> None:
    readings = positions(agent, 1)[0]
    known = joined(submaps[:20], readings)
    known.save(tmp_path / "map")
    loaded = GlobalMap.load(tmp_path / "map", CONFIG)
    before, after = known.snapshot().fixed_frame(), loaded.snapshot().fixed_frame()
    assert before is not None
    assert after is not None
    assert np.array_equal(before.T, after.T)
    for s in submaps[20:]:
        loaded.add(s, [r for r in readings if s.start_stamp_ns < r.stamp_ns <= s.end_stamp_ns])
    assert loaded.counters.counts[USED] > 30
    assert ate(loaded, agent) < 0.12


def test_a_frame_that_is_not_found_is_looked_for_ever_more_seldom(
    submaps: list[Submap], agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []
    monkeypatch.setattr(position_links, "find_frame", lambda antenna, *_: looks.append(len(antenna)))
    monkeypatch.setattr(position_links, "_MOST_RECORDS", 20)
    joined(submaps, positions(agent, 1, every=1)[0])
    assert looks[0] == 8
    assert all(b >= 1.1 * a or b >= 20 * 7 for a, b in pairwise(looks))
    assert len(looks) < 0.8 * len(submaps)
    assert looks[-1] == 20 * 8


def test_a_map_too_sure_of_itself_does_not_refuse_all_positions_of_a_submap(
    agent: Agent, submaps: list[Submap]
) -> None:
    sure = [
        replace(
            s, covariance=0.04 * s.covariance, path=tuple(replace(p, covariance=0.04 * p.covariance) for p in s.path)
        )
        for s in submaps
    ]
    known = joined(sure, positions(agent, 1, every=1)[0])
    assert known.counters.counts.get(REFUSED, 0) <= 2
    assert ate(known, agent) < 0.12


def test_settling_looks_for_the_frame_whatever_has_come_since(
    submaps: list[Submap], agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(position_links, "_GROWTH", 1000.0)
    known = joined(submaps, positions(agent, 1)[0])
    assert USED not in known.counters.counts
    known.settle()
    assert known.counters.counts[USED] > 115
    assert ate(known, agent) < 0.12


def test_records_that_a_frame_was_not_looked_for_with_follow(
    submaps: list[Submap], agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(position_links, "_MOST_RECORDS", 6)
    known = joined(submaps, positions(agent, 1)[0])
    assert known.positions.waiting_count == 0
    assert known.counters.counts[USED] > 115


def test_positions_that_wait_are_stored(agent: Agent, submaps: list[Submap], tmp_path: Path) -> None:
    readings = positions(agent, 1)[0]
    straight = [r for r in readings if r.stamp_ns <= submaps[7].end_stamp_ns]
    known = joined(submaps[:8], straight)
    assert known.positions.waiting_count == len(straight) > 20
    known.save(tmp_path / "map")
    loaded = GlobalMap.load(tmp_path / "map", CONFIG)
    for s in submaps[8:]:
        loaded.add(s, [r for r in readings if s.start_stamp_ns < r.stamp_ns <= s.end_stamp_ns])
    assert loaded.positions.waiting_count == 0
    assert {r.stamp_ns for r in straight} - {r.stamp_ns for r in used(loaded)} == set()
    (stored,) = (tmp_path / "map").glob("*.npz")
    with np.load(stored) as arrays:
        changed = dict(arrays)
    for name, value in (("records", changed["waiting/records"] * 0), ("positions", np.zeros((2, 3)))):
        with pytest.raises(ValueError, match="position"):
            stored_waiting(changed | {f"waiting/{name}": value})


def test_all_but_the_newest_submaps_are_on_disk(agent: Agent, submaps: list[Submap]) -> None:
    known = joined(submaps, positions(agent, 1)[0])
    in_memory = [r.key for r in known.state.graph.records if not known._offload._holds(r.submap.covariance)]
    assert in_memory == [(name, 0, index) for index in (29, 30) for name in ("a", "position/a")]


def test_a_map_joined_anew_in_time_order_keeps_its_positions(agent: Agent, submaps: list[Submap]) -> None:
    known = joined(submaps, positions(agent, 1)[0])
    settled = joined(submaps, positions(agent, 1)[0])
    settled.settle()
    settled._is_out_of_order = True
    again = settled.rebuilt_in_time_order()
    assert again is not settled
    assert [r.key for r in again.state.graph.records] == [r.key for r in known.state.graph.records]
    assert again.counters.counts == known.counters.counts
    known.settle()
    assert np.abs(again.state.poses - known.state.poses).max() < 1e-6


def test_two_agents_that_see_nothing_in_common_are_tied_by_their_positions() -> None:
    first, second = drive(1), drive(2)
    second.name, second.stamp_ns = "b", 10**9 * 1000
    known = GlobalMap(CONFIG)
    for agent in (first, second):
        readings = positions(agent, 5)[0]
        for s in agent.submaps():
            known.add(s, [r for r in readings if s.start_stamp_ns < r.stamp_ns <= s.end_stamp_ns])
    assert known.components == 1
    known.settle()
    e, nees = errors(known, second, first)
    assert np.linalg.norm(e[:, :3], axis=1).mean() < 0.5
    assert nees.mean() / 6.0 < 2.5
