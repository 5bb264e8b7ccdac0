from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap
from sjsam_node.localization import Localizer
from slam_core.geometry import boxminus, boxplus, invert_transform
from slam_core.types import PoseEstimate, Submap


@pytest.fixture
def agent(rng: np.random.Generator) -> Agent:
    return Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.3), rng, "a")


def test_a_map_comes_back_to_the_last_bit(agent: Agent, tmp_path: Path) -> None:
    joined, _ = join(agent.submaps())
    joined.save(tmp_path / "map")
    loaded = GlobalMap.load(tmp_path / "map")
    assert np.array_equal(loaded.graph.poses, joined.graph.poses)
    assert np.array_equal(loaded.graph.points, joined.graph.points)
    assert np.array_equal(loaded.graph.landmark_of, joined.graph.landmark_of)
    for p, q in zip(loaded.trajectory("a"), joined.trajectory("a"), strict=True):
        assert p.stamp_ns == q.stamp_ns
        assert np.array_equal(p.T, q.T)
        assert np.allclose(p.covariance, q.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("stop", [3, 14, 20])
def test_saved_killed_loaded_and_continued_gives_the_same_map(stop: int, agent: Agent, tmp_path: Path) -> None:
    submaps = agent.submaps()
    whole, _ = join(submaps[:stop])
    whole.marks.add(whole.graph, np.array([1.0, 2.0, 0.5]), "a find")
    whole.save(tmp_path / "map")
    continued, reports = join(submaps[stop:], GlobalMap.load(tmp_path / "map"))
    _, expected = join(submaps[stop:], whole)
    assert [r.closures for r in reports] == [r.closures for r in expected]
    assert np.array_equal(continued.graph.landmark_of, whole.graph.landmark_of)
    assert np.abs(continued.graph.points - whole.graph.points).max() < 1e-9
    for p, q in zip(continued.trajectory("a"), whole.trajectory("a"), strict=True):
        assert np.abs(boxminus(p.T, q.T)).max() < 1e-9
        assert np.allclose(p.covariance, q.covariance, rtol=1e-6, atol=1e-12)
    assert np.allclose(continued.marks.positions(continued.graph), whole.marks.positions(whole.graph), atol=1e-9)
    assert [m.name for m in continued.marks.marks] == ["a find"]


def test_saving_in_between_does_not_matter(agent: Agent, tmp_path: Path) -> None:
    submaps = agent.submaps()
    plain, _ = join(submaps)
    saving, _ = join(submaps[:14])
    saving.save(tmp_path / "map")
    join(submaps[14:], saving)
    assert len(saving.landmarks().ids) == len(plain.landmarks().ids)
    for p, q in zip(saving.trajectory("a"), plain.trajectory("a"), strict=True):
        assert np.abs(boxminus(p.T, q.T)).max() < 1e-6


def test_saving_replaces_and_leaves_nothing_else(agent: Agent, tmp_path: Path) -> None:
    joined, _ = join(agent.submaps()[:3])
    joined.save(tmp_path / "map")
    joined.save(tmp_path / "map")
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == ["arrays.npz", "manifest.json"]


def test_foreign_newer_and_damaged_folders_are_refused(agent: Agent, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    with pytest.raises(ValueError, match="not a map"):
        GlobalMap.load(folder)
    joined, _ = join(agent.submaps()[:3])
    joined.save(folder)
    manifest, arrays = folder / "manifest.json", folder / "arrays.npz"
    good, data = manifest.read_text(), arrays.read_bytes()
    for text, why in (
        ("{", "not JSON"),
        ("[]", "not a map of this program"),
        (json.dumps({"format": "other"}), "not a map of this program"),
        (json.dumps({**json.loads(good), "version": 99}), "version 99"),
        (json.dumps({**json.loads(good), "sha256": "0"}), "damaged"),
    ):
        manifest.write_text(text)
        with pytest.raises(ValueError, match=why):
            GlobalMap.load(folder)
    manifest.write_text(good)
    arrays.write_bytes(data[:-100])
    with pytest.raises(ValueError, match="damaged"):
        GlobalMap.load(folder)
    arrays.unlink()
    with pytest.raises(ValueError, match=r"arrays\.npz"):
        GlobalMap.load(folder)


def visitor(agent: Agent, rng: np.random.Generator) -> tuple[Agent, list[Submap]]:
    again = Agent(agent.world, agent.path[10:60], rng, "visitor", stamp_ns=10**12)
    return again, again.submaps()


def test_a_visitor_is_located_by_looks_and_the_map_does_not_change(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    before = joined.graph.poses.copy()
    again, submaps = visitor(agent, rng)
    localizer = Localizer(joined)
    results = [localizer.process(submap) for submap in submaps]
    T = invert_transform(agent.path[0])
    assert sum(r.matched > 0 for r in results) >= len(results) // 2
    for k, result in enumerate(results):
        if result.pose is not None:
            assert np.linalg.norm((T @ again.true_start(k + 1) - result.pose.T)[:3, 3]) < 0.5
    assert results[-1].pose is not None
    assert np.array_equal(joined.graph.poses, before)
    assert len(joined.graph.records) == len(agent.seen)


def test_an_initial_pose_is_enough_to_start(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    again, submaps = visitor(agent, rng)
    T = invert_transform(agent.path[0]) @ again.path[0]
    localizer = Localizer(joined)
    localizer.set_pose(
        PoseEstimate(0, boxplus(T, np.array([0.1, -0.1, 0.05, 0.0, 0.0, 0.03])), np.diag([0.04] * 3 + [0.01] * 3))
    )
    result = localizer.process(submaps[0])
    assert result.matched > 0
    assert result.pose is not None
    truth = invert_transform(agent.path[0]) @ again.true_start(1)
    assert np.linalg.norm((truth - result.pose.T)[:3, 3]) < 0.15


def test_a_stranger_is_not_located(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    elsewhere = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "visitor")
    localizer = Localizer(joined)
    assert all(localizer.process(s).pose is None for s in elsewhere.submaps())
