# SPDX-License-Identifier: Apache-2.0
"""The map on its writer's thread, without ROS: what is answered at once, and what an empty map does not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

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
    assert len(live.poses) == len(submaps) == len(live.global_map.graph.records) + 1
    assert live.waiting == 0
    assert len(GlobalMap.load(tmp_path / "copy.ended").graph.records) == len(submaps) - 1
