# SPDX-License-Identifier: Apache-2.0
"""The map on its writer's thread, without ROS: what is answered at once, and what an empty map does not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node import storage
from sjsam_node.agents import in_order
from sjsam_node.autosave import Autosave
from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.live_map import LiveMap


def test_a_mark_that_an_empty_map_refuses_makes_no_copy(tmp_path: Path) -> None:
    live = LiveMap(GlobalMapConfig(), Autosave(tmp_path / "copy", 10.0))
    with pytest.raises(ValueError, match="empty map"):
        live.mark(np.zeros(3))
    assert live.save_copy() is None
    live.close()
    assert list(tmp_path.iterdir()) == []


def test_what_one_submap_raises_reaches_its_future_and_the_next_is_joined(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    submaps = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "a").submaps()
    add = GlobalMap.add
    monkeypatch.setattr(GlobalMap, "add", lambda joined, s: add(joined, s) if s.index else 1 / 0)
    live = LiveMap(GlobalMapConfig(), Autosave(tmp_path / "copy", 10.0))
    futures = [live.add(submap) for submap in submaps]
    live.close()
    assert isinstance(futures[0].exception(), ZeroDivisionError)
    found = [future.result() for future in futures[1:]]
    assert all(joined is not None and joined.report.accepted for joined in found)
    assert len(live.snapshot.poses) == len(submaps) == len(live.snapshot) + 1
    assert live.waiting == 0
    assert len(GlobalMap.load(tmp_path / "copy.ended").estimate.graph.records) == len(submaps) - 1


@pytest.mark.parametrize("saved_on_the_way", [False, True])
def test_a_finished_map_is_that_of_an_offline_run_to_the_byte_whoever_came_first(
    rng: np.random.Generator, tmp_path: Path, saved_on_the_way: bool
) -> None:
    """Two agents in one ring; the second one's submaps come first, and a mark is set."""
    world, path = ring_world(4.0, rng, 12.0), circle(4.0, 1.0)
    A = Agent(world, path[:61], rng, "a").submaps()
    B = Agent(world, path[45:], rng, "b", stamp_ns=2_000_000_000).submaps()
    offline = GlobalMap()
    for submap in in_order(A + B):
        offline.add(submap)
    offline.rebuilt_in_time_order().save(tmp_path / "offline", is_last=True)
    live = LiveMap(GlobalMapConfig(), Autosave(tmp_path / "copy", 0.0))
    for k, submap in enumerate(B + A):
        joined = live.add(submap)
        if saved_on_the_way and k == len(B) // 2:
            joined.result()
            live.save(tmp_path / "early").result()
    live.finish().result()
    live.save(tmp_path / "live").result()
    live.mark(np.zeros(3))
    live.finish().result()
    assert len(live.snapshot.marks.marks) == 1
    live.close()
    one, other = (storage.read(tmp_path / name) for name in ("offline", "live"))
    assert one.state.graph.records[0].key[0] == other.state.graph.records[0].key[0] == "a"
    for name in ("offline", "live"):
        files = sorted(p.name for p in (tmp_path / name).iterdir())
        assert files == sorted(p.name for p in (tmp_path / "offline").iterdir()), "arrays are named after their digest"
    manifests = [(tmp_path / name / "manifest.json").read_bytes() for name in ("offline", "live")]
    assert manifests[0] == manifests[1]
