# SPDX-License-Identifier: Apache-2.0
"""The copy of the map that a killed node goes on from."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap
from sjsam_node.session.autosave import Autosave


@pytest.fixture
def joined(rng: np.random.Generator) -> GlobalMap:
    return join(Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.4), rng, "a").submaps())[0]


def test_a_copy_is_found_after_a_kill_and_not_after_an_end_in_order(joined: GlobalMap, tmp_path: Path) -> None:
    path = tmp_path / "map.autosave"
    autosave = Autosave(path, 10.0)
    assert autosave.found() is None
    assert autosave.is_due(0.0)
    autosave.save(joined.stored(), 0.0)
    autosave._job.result()
    assert not autosave.is_due(9.0)  # however late it is looked whether the copy is written
    assert autosave.is_due(10.1)
    with pytest.raises(ValueError, match=f"in use by another process, number {os.getpid()}"):
        Autosave(path, 10.0)
    autosave.close()  # and not put away, as a killed one
    second = Autosave(path, 10.0)
    copy = GlobalMap.load(second.found() or Path())
    assert np.array_equal(copy.state.poses, joined.state.poses)
    second.retire()
    second.close()
    assert [p.name for p in tmp_path.iterdir()] == ["map.autosave.ended"]
    assert Autosave(path, 10.0).found() is None
    assert len(GlobalMap.load(autosave.ended).estimate.graph.records) == len(joined.estimate.graph.records)


def test_what_is_not_ours_stays(joined: GlobalMap, tmp_path: Path) -> None:
    path = tmp_path / "thesis"
    path.mkdir()
    (path / "chapter.tex").write_text("years of work")
    autosave = Autosave(path, 1.0)
    autosave.save(joined.stored(), 0.0)
    autosave.wait()
    autosave.retire()
    assert [p.name for p in path.iterdir()] == ["chapter.tex"]
    assert (path / "chapter.tex").read_text() == "years of work"
    autosave.save(joined.stored(), 5.0)
    autosave.close()
    with pytest.raises(ValueError, match="other files"):
        autosave.is_due(100.0)


def test_a_map_that_is_saved_again_is_never_absent(
    joined: GlobalMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed at the worst moment, before the manifest is renamed, the old map is still there."""
    joined.save(tmp_path / "map")
    joined.marks.add(joined.state.poses, np.zeros(3))

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sjsam_node.map_file.storage.os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        joined.save(tmp_path / "map")
    monkeypatch.undo()
    assert GlobalMap.load(tmp_path / "map").marks.marks == []
    joined.save(tmp_path / "map")
    assert len(GlobalMap.load(tmp_path / "map").marks.marks) == 1
    assert len(list((tmp_path / "map").iterdir())) == 2
