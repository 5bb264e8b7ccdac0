# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judging import ate, chain_error, errors, join
from submap_world import Agent, Sensor, World, circle, path_through, pose, ring_world, room

from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.smoothing.condensing import RegionConfig
from sjsam_node.smoothing.solver import SmootherConfig
from slam_core.geometry import boxminus, invert_transform
from slam_core.types import Submap


def ring_agent(rng: np.random.Generator, turns: float = 1.25, radius: float = 4.0, name: str = "a") -> Agent:
    return Agent(ring_world(radius, rng, 12.0), circle(radius, turns), rng, name)


def test_a_loop_closes_and_the_landmarks_of_the_second_lap_are_those_of_the_first(rng: np.random.Generator) -> None:
    agent = ring_agent(rng)
    submaps = agent.submaps()
    joined, reports = join(submaps)
    e, _ = errors(joined, agent)
    assert any(r.closures for r in reports)
    assert ate(e) < 0.2
    assert np.linalg.norm(e[-1, :3]) < 0.1 < chain_error(agent, submaps)
    seen = np.unique(np.concatenate(agent.seen))
    assert len(joined.landmarks().ids) <= 1.02 * len(seen)


def test_after_a_way_without_images_no_landmark_is_matched_by_place_alone(rng: np.random.Generator) -> None:
    """The end of one submap is known to a decimetre: the next stays tied to it, by the way alone."""
    submaps = ring_agent(rng, turns=0.75).submaps()
    covariance = submaps[2].covariance.copy()
    covariance[:3, :3] += 0.01 * np.eye(3)
    submaps[2] = replace(submaps[2], covariance=covariance)
    joined, reports = join(submaps[:5])
    assert [report.matched > 0 for report in reports] == [False, True, True, False, True]
    assert joined.components == 1


def test_landmark_count_stays_bounded_over_laps(rng: np.random.Generator) -> None:
    agent = ring_agent(rng, turns=3.0, radius=3.0)
    joined, _ = join(agent.submaps())
    joined.settle()
    assert len(joined.landmarks().ids) <= 1.05 * len(np.unique(np.concatenate(agent.seen)))


def test_joined_covariances_are_honest() -> None:
    nees, landmark_nees = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        agent = ring_agent(rng, radius=3.0)
        joined, _ = join(agent.submaps())
        _, values = errors(joined, agent)
        nees.append(values.mean() / 6.0)
        found = joined.landmarks()
        world = (agent.world.points - agent.path[0][:3, 3]) @ agent.path[0][:3, :3]
        e = world[np.argmax(found.descriptors @ agent.world.descriptors.T, axis=1)] - found.positions
        landmark_nees.append(
            np.einsum("ni,ni->n", e, np.linalg.solve(found.covariances, e[..., None])[..., 0]).mean() / 3.0
        )
    # Poses of one run are correlated: each run's mean is a draw with a spread of about 0.35.
    assert 0.8 < np.mean(nees) < 1.25
    assert 0.75 < np.mean(landmark_nees) < 1.3


def read_all(joined: GlobalMap) -> None:
    """Everything that the node and its services read."""
    joined.landmarks()
    joined.trajectory()
    joined.path()
    for agent in "ab":
        joined.end_pose(agent)
        joined.map_to_odom(agent)
    joined.snapshot().start(len(joined.estimate.graph.records) // 2)
    joined.estimate.relative_pose(0, len(joined.estimate.graph.records) - 1)
    joined.marks.positions(joined.state.poses)


def same_reports(one: list[JoinReport], other: list[JoinReport]) -> bool:
    return all(vars(a) == vars(b) for a, b in zip(one, other, strict=True))


def same_map(one: GlobalMap, other: GlobalMap) -> bool:
    """Whether two maps are the same to the last bit, covariances included."""
    pairs = [
        (one.state.poses, other.state.poses),
        (one.state.points, other.state.points),
        (one.landmarks().covariances, other.landmarks().covariances),
        *(
            (p.covariance, q.covariance)
            for k in "ab"
            for p, q in zip(one.trajectory(k), other.trajectory(k), strict=True)
        ),
    ]
    return all(np.array_equal(a, b) for a, b in pairs)


def test_reading_the_map_changes_nothing_to_the_last_bit(rng: np.random.Generator, tmp_path: Path) -> None:
    """Small regions, two agents, closures; read after every submap, or never."""
    world, path = ring_world(8.0, rng, 12.0), circle(8.0, 1.1)
    A = Agent(world, path[:161], rng, "a").submaps()
    B = Agent(world, path[121:], rng, "b", stamp_ns=5_000_000_000).submaps()
    submaps = [s for pair in zip(A, B, strict=False) for s in pair] + A[len(B) :]
    small = SmootherConfig(region=RegionConfig(size=8, open=12, quiet=1))
    read, unread = (GlobalMap(GlobalMapConfig(smoothing=small)) for _ in range(2))
    reports: list[JoinReport] = []
    closed = 0
    for submap in submaps:
        reports.append(read.add(submap))
        read_all(read)
        closed += len(read.state.problem(0).condensed)
    assert any(r.closures for r in reports)
    assert closed > 10
    assert same_reports(reports, join(submaps, unread)[1])
    assert same_map(read, unread)
    for joined in (read, unread):
        joined.save(tmp_path / "map")
        read_all(read)
    assert same_map(read, unread)


def test_settling_brings_the_map_to_its_optimum_with_all_landmarks(rng: np.random.Generator) -> None:
    submaps = ring_agent(rng, turns=1.0).submaps()
    few, _ = join(submaps, GlobalMap(GlobalMapConfig(ties=6)))
    every, _ = join(submaps, GlobalMap(GlobalMapConfig(ties=24)))
    assert few.state.totals()[1] < 0.5 * every.state.totals()[1]
    gaps = []
    for _ in range(2):
        a, b = few.trajectory("a"), every.trajectory("a")
        gaps.append(max(np.abs(boxminus(p.T, q.T)).max() for p, q in zip(a, b, strict=True)))
        few.settle()
        every.settle()
    assert gaps[1] < 1e-6 < gaps[0]


def test_few_ties_are_within_a_sigma_of_all(rng: np.random.Generator) -> None:
    submaps = ring_agent(rng, turns=1.25).submaps()
    few, _ = join(submaps, GlobalMap(GlobalMapConfig(ties=16)))
    every, _ = join(submaps, GlobalMap(GlobalMapConfig(ties=1000)))
    for p, q in zip(few.trajectory("a")[1:], every.trajectory("a")[1:], strict=True):
        gap = boxminus(p.T, q.T)
        assert gap @ np.linalg.solve(p.covariance, gap) < 6.0


def building(rng: np.random.Generator, alike: bool) -> tuple[World, list[tuple[float, float]]]:
    """Two rooms at the ends of a corridor, which look alike to the last descriptor or not, and a walk through both."""
    first = room((0.0, 0.0), (4.0, 4.0), 90, rng)
    second = first + np.array([14.0, 0.0, 0.0]) if alike else room((14.0, 0.0), (4.0, 4.0), 90, rng)
    corridor = np.stack([rng.uniform(2, 12, 120), rng.choice([-1.2, 1.2], 120), rng.uniform(-1, 1.5, 120)], axis=1)
    world = World.random(np.concatenate([first, second, corridor]), rng)
    if alike:
        world.descriptors[90:180] = world.descriptors[:90]
    walk = [(-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (13.0, 0.0), (13.0, -1.0), (15.0, -1.0), (15.0, 1.0), (13.0, 1.0)]
    return world, walk


def test_two_rooms_that_look_alike_are_not_joined(rng: np.random.Generator) -> None:
    world, walk = building(rng, alike=True)
    agent = Agent(world, path_through(walk), rng, "a", Sensor(max_range=3.5))
    submaps = agent.submaps()
    joined, _ = join(submaps)
    e, _ = errors(joined, agent)
    assert ate(e) < 0.25
    first, second = joined.landmarks().positions[:, 0] < 5.0, joined.landmarks().positions[:, 0] > 9.0
    assert first.sum() > 40
    assert second.sum() > 40


def agents_in_one_ring(rng: np.random.Generator) -> tuple[Agent, Agent]:
    world = ring_world(4.0, rng, 12.0)
    path = circle(4.0, 1.0)
    first = Agent(world, path[:61], rng, "a")
    return first, Agent(world, path[45:], rng, "b", stamp_ns=5_000_000_000)


@pytest.mark.parametrize("order", ["ab", "ba", "alternating"])
def test_agents_are_joined_when_they_share_a_place_in_any_order(order: str, rng: np.random.Generator) -> None:
    a, b = agents_in_one_ring(rng)
    A, B = a.submaps(), b.submaps()
    mixed = [s for pair in zip(A, B, strict=False) for s in pair] + A[len(B) :] + B[len(A) :]
    joined, _ = join({"ab": A + B, "ba": B + A, "alternating": mixed}[order])
    assert joined.components == 1
    for agent in (a, b):
        e, _ = errors(joined, agent, origin=a)
        assert ate(e) < 0.15


def test_joining_does_not_depend_on_the_order_of_agents(rng: np.random.Generator) -> None:
    a, b = agents_in_one_ring(rng)
    A, B = a.submaps(), b.submaps()
    one, _ = join(A + B)
    other, _ = join(B + A)
    one.settle()
    other.settle()
    assert one.state.totals()[0] == pytest.approx(other.state.totals()[0], rel=0.02)
    for name in "ab":
        gap = [
            np.abs(boxminus(p.T, q.T)).max() for p, q in zip(one.trajectory(name), other.trajectory(name), strict=True)
        ]
        assert max(gap) < 0.02


def test_agents_that_never_meet_stay_apart_and_are_flagged(rng: np.random.Generator) -> None:
    a = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "a")
    b = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "b")
    joined, _ = join(a.submaps() + b.submaps())
    assert joined.components == 2
    assert joined.trajectory("b")[-1].covariance[0, 0] > 50.0**2 > joined.trajectory("a")[-1].covariance[0, 0]


def test_a_restarted_agent_is_found_again(rng: np.random.Generator) -> None:
    world = ring_world(4.0, rng, 12.0)
    path = circle(4.0, 1.0)
    first, again = Agent(world, path[:49], rng, "a"), Agent(world, path[20:69], rng, "a", stamp_ns=10**11)
    joined, reports = join(first.submaps() + [replace(s, session=1) for s in again.submaps()])
    assert all(r.accepted for r in reports)
    assert joined.components == 1
    T = invert_transform(path[0])
    last = joined.trajectory("a")[-1]
    error = boxminus(T @ path[68], last.T)
    assert error @ np.linalg.solve(last.covariance, error) < 25.0
    assert sum(bool(r.closures) for r in reports) > 3


def test_an_agent_that_falls_silent_does_no_harm(rng: np.random.Generator) -> None:
    a, b = agents_in_one_ring(rng)
    A, B = a.submaps(), b.submaps()
    joined, _ = join(A[:3] + B[:6])
    last = joined.trajectory("a")[-1]
    _, reports = join(B[6:], joined)
    assert all(r.accepted for r in reports)
    assert joined.components == 1  # at the end of the ring it sees the place where the silent one began
    assert ate(errors(joined, b, origin=a)[0]) < 0.15
    known = joined.trajectory("a")[-1]
    assert known.stamp_ns == last.stamp_ns
    assert np.all(np.isfinite(known.covariance))
    assert np.linalg.norm((invert_transform(a.path[0]) @ a.true_start(3) - known.T)[:3, 3]) < 0.1


def test_after_a_loss_the_new_stretch_is_tied_to_the_map_when_a_place_is_recognised(rng: np.random.Generator) -> None:
    agent = ring_agent(rng, turns=1.5)
    submaps = agent.submaps()
    lost = [replace(s, follows_previous=False) if s.index == 12 else s for s in submaps]
    joined, reports = join(lost)
    assert (
        joined.estimate.graph.records[12].start != joined.estimate.graph.records[11].end
    )  # nothing but what it looks like ties it
    assert reports[12].closures
    assert reports[-1].components == 1
    e, _ = errors(joined, agent)
    assert ate(e) < 0.15


def test_what_cannot_be_joined_is_refused_and_changes_nothing(rng: np.random.Generator) -> None:
    submaps = ring_agent(rng, turns=0.2).submaps()
    joined, _ = join(submaps)
    before = joined.state.poses.copy()
    bad = submaps[0].covariance.copy()
    bad[0, 0] = -1.0
    indefinite = submaps[0].covariance.copy()
    indefinite[0, 1] = indefinite[1, 0] = 2.0 * np.sqrt(indefinite[0, 0] * indefinite[1, 1])
    nan = submaps[0].landmarks.copy()
    nan[0] = np.nan
    later = 10**12
    for fault in (
        replace(submaps[0], covariance=bad, start_stamp_ns=later),
        replace(submaps[0], covariance=indefinite, start_stamp_ns=later),
        replace(submaps[0], landmarks=nan, start_stamp_ns=later),
        replace(submaps[0], descriptors=submaps[0].descriptors[:, :64], start_stamp_ns=later),
        submaps[1],
    ):
        report = joined.add(fault)
        assert not report.accepted
        assert report.reason
    assert np.array_equal(joined.state.poses, before)
    assert sum(joined.counters.counts.values()) == 5
    assert joined.counters.counts["refused: covariance is not positive definite"] == 1


def test_false_matches_are_taken_back(rng: np.random.Generator) -> None:
    """A tenth of the landmarks carry another landmark's descriptor and id."""
    agent = ring_agent(rng)
    submaps = agent.submaps()
    clean, _ = join(submaps)
    spoiled, _ = join(spoil(submaps, 0.1, rng))
    e_clean, _ = errors(clean, agent)
    e_spoiled, _ = errors(spoiled, agent)
    assert ate(e_spoiled) < 2.0 * ate(e_clean)


def spoil(submaps: list[Submap], share: float, rng: np.random.Generator) -> list[Submap]:
    out = []
    for submap in submaps:
        wrong = rng.choice(len(submap.landmarks), int(share * len(submap.landmarks)), replace=False)
        turned = np.roll(wrong, 1)
        descriptors, ids = submap.descriptors.copy(), submap.landmark_ids.copy()
        descriptors[wrong], ids[wrong] = descriptors[turned], ids[turned]
        out.append(replace(submap, descriptors=descriptors, landmark_ids=ids))
    return out


def test_an_empty_submap_is_joined_by_its_odometry(rng: np.random.Generator) -> None:
    submaps = ring_agent(rng, turns=0.3).submaps()
    s = submaps[1]
    empty = replace(
        s,
        landmarks=s.landmarks[:0],
        covariance=s.covariance[:6, :6],
        landmark_ids=s.landmark_ids[:0],
        sightings=s.sightings[:0],
        descriptors=s.descriptors[:0],
    )
    joined, reports = join([submaps[0], empty, *submaps[2:]])
    assert all(r.accepted for r in reports)
    assert joined.components == 1


def test_map_to_odom_carries_the_odometry_onto_the_map(rng: np.random.Generator) -> None:
    agent = ring_agent(rng)
    submaps = agent.submaps()
    joined, _ = join(submaps)
    T_odom = np.eye(4)
    for submap in submaps:
        T_odom = T_odom @ submap.end_pose
    T_map = invert_transform(agent.path[0]) @ agent.true_start(len(submaps))
    assert np.linalg.norm((joined.map_to_odom("a") @ T_odom - T_map)[:3, 3]) < 0.1


def test_a_restarted_filter_goes_on_in_a_session_of_its_own(rng: np.random.Generator, tmp_path: Path) -> None:
    agent = ring_agent(rng, turns=1.5)
    submaps = agent.submaps()
    again = [replace(s, session=7, index=s.index - 14, follows_previous=s.index > 14) for s in submaps[14:]]
    joined, reports = join([*submaps[:14], *again])
    assert all(r.accepted for r in reports)
    assert len(joined.estimate.graph.records) == len(submaps)
    assert reports[-1].components == 1
    end = np.linalg.multi_dot([s.end_pose for s in again])
    assert np.allclose(joined.odometry_pose("a").T, end)
    joined.save(tmp_path / "map")
    assert [r.key for r in GlobalMap.load(tmp_path / "map").estimate.graph.records] == [
        r.key for r in joined.estimate.graph.records
    ]
    refused = joined.add(replace(submaps[3], start_stamp_ns=-1))
    assert "session" in refused.reason


def test_an_empty_map_answers() -> None:
    empty = GlobalMap()
    assert empty.trajectory() == {}
    assert len(empty.landmarks().ids) == 0
    assert np.array_equal(empty.map_to_odom("a"), np.eye(4))
    assert pose(0.0, 0.0, 0.0).shape == (4, 4)
