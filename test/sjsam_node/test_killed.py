# SPDX-License-Identifier: Apache-2.0
"""The process of ``sjsam`` is killed; another one goes on from its map. One and the same copy has one writer."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

pytest.importorskip("rclpy")
pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("domain")]

from joiner_process import call, neighbour, running, send  # noqa: E402

from sjsam_node.global_map import GlobalMap  # noqa: E402
from sjsam_node.map_file.storage import is_map  # noqa: E402


def test_a_killed_node_goes_on_from_its_saved_map(rng: np.random.Generator, tmp_path: Path) -> None:
    agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 1.2), rng, "")
    submaps, half = agent.submaps(), 12
    with running(f"map_path:={tmp_path / 'map'}"), neighbour() as probe:
        send(probe, submaps[:half], half * agent.steps + 1)
        assert call(probe, "save_map").success
        assert len(GlobalMap.load(tmp_path / "map.autosave").estimate.graph.records) == half  # no less than was saved
        assert call(probe, "mark_here").success  # after saving: must be gone
    saved = GlobalMap.load(tmp_path / "map")
    assert not saved.marks.marks
    with running(f"map_path:={tmp_path / 'map'}") as second:
        with neighbour() as probe:
            assert call(probe, "load_map").success
            send(probe, submaps[half:], len(submaps) * agent.steps + 1)
            assert call(probe, "save_map").success
        second.send_signal(signal.SIGINT)
        assert second.wait(20) == 0
    continued = GlobalMap.load(tmp_path / "map")
    join(submaps[half:], saved)
    saved.settle()  # as saving does
    assert any(k.is_closure for k in continued.estimate.graph.links)
    assert len(continued.estimate.graph.links) == len(saved.estimate.graph.links)
    assert np.abs(continued.state.poses - saved.state.poses).max() < 1e-9


def test_the_default_copy_is_found_from_any_folder_and_has_one_writer(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second process with the same copy does not start while the first lives, and goes on from it after a kill."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    copy = tmp_path / "state" / "indoor_slam" / "map.autosave"
    agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.3), rng, "")
    submaps = agent.submaps()
    folders = [tmp_path / "one", tmp_path / "two"]
    for folder in folders:
        folder.mkdir()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with running("autosave_period_s:=0.1", cwd=folders[0]) as first:
        with neighbour() as probe:
            send(probe, submaps, len(submaps) * agent.steps + 1)
            probe.wait(lambda: is_map(copy), "no copy")
        with running(cwd=folders[1], **pipes) as second:
            said, _ = second.communicate(timeout=60)
        assert second.returncode == 2
        assert f"cannot start: {copy} is in use by another process, number {first.pid}: set autosave_path" in said
        assert first.poll() is None
        first.send_signal(signal.SIGKILL)
        first.wait()
    with running(cwd=folders[1], **pipes) as third:
        assert third.stdout is not None
        assert any("a node was killed: going on from" in line for line in third.stdout)
        third.send_signal(signal.SIGINT)
        assert third.wait(20) == 0
    assert sorted(p.name for p in copy.parent.iterdir()) == ["map.autosave.ended"]
    assert not any(p for folder in folders for p in folder.iterdir())
