# SPDX-License-Identifier: Apache-2.0
"""``slam run`` on several recordings: the bytes of single runs, one table, and a bad one that stops no other."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from demo_parts import DEMO, call, cut
from sjsam_node.regions.tasks import InProcess
from slam_bringup.jobs import many_runs
from slam_bringup.jobs.many_runs import RunOutcome, folder_names, outcomes_table, run_many
from slam_bringup.jobs.recording_run import RunOptions
from slam_bringup.processes.interrupt import INTERRUPTED
from slam_bringup.terminal.run_end import FAILED


def result_bytes(out: Path) -> dict[str, bytes]:
    """All that a run writes but what says when, how fast and by which command it was made."""
    told = ("summary.json", "report.html", "logs/slam.log", ".slam.json")
    files = {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    return {name: content for name, content in files.items() if name not in told}


@pytest.mark.slow
def test_several_recordings_are_mapped_to_the_bytes_of_single_runs_and_a_bad_one_fails_alone(tmp_path):
    pytest.importorskip("distributed")
    first, second = cut(tmp_path / "first.mcap", 0.0, 0.25), cut(tmp_path / "second.mcap", 0.5, 0.75)
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(first.read_bytes()[:2000])
    done = call("run", first, bad, second, "-o", tmp_path / "many", "--workers", 2)
    assert done.exit_code == FAILED, done.output
    assert str(bad) in done.stderr
    for name in ("first", "bad", "second"):
        assert name in done.stdout
    assert not (tmp_path / "many" / "bad").exists()
    for bag in (first, second):
        one, of_many = tmp_path / bag.stem, tmp_path / "many" / bag.stem
        assert call("run", bag, "-o", one).exit_code == 0
        expected = result_bytes(one)
        assert {"trajectory.tum", "result.mcap", "map.png", "mesh.glb"} <= expected.keys()
        assert result_bytes(of_many) == expected
        summary = json.loads((of_many / "summary.json").read_text())
        assert summary["frames"] > 10
        assert summary["total_s"] < 600.0


def test_the_folder_of_a_recording_has_its_name_and_as_many_above_as_tell_it_from_others(tmp_path):
    bags = [tmp_path / name for name in ("monday/rig.mcap", "tuesday/rig.mcap", "walk.mcap", "folder.v1")]
    for bag in bags[:3]:
        bag.parent.mkdir(exist_ok=True)
        bag.touch()
    bags[3].mkdir()
    assert folder_names(bags) == ["monday_rig", "tuesday_rig", "walk", "folder.v1"]
    with pytest.raises(ValueError, match=r"walk.mcap is named twice"):
        folder_names([bags[2], bags[2]])


def test_a_worker_that_is_lost_fails_its_recording_alone(tmp_path, monkeypatch):
    class Lossy(InProcess):
        def gather(self, handles):
            if handles[0].bag.name == "lost":
                raise ValueError("several workers ended at the same task")
            return list(handles)

    summary = {"failure": "", "degraded": [], "state": "OK", "frames": 3, "lost_share": {"": 0.5}, "submaps": 1,
               "path_length_m": 2.0, "loop_closures": 0, "wall_s": 1.0, "ate_rmse_m": 0.0123}  # fmt: skip
    told = []

    def mapped(task, number, tell):
        tell((number, 5, 10))
        return RunOutcome(task.bag, task.output, summary)

    monkeypatch.setattr(many_runs, "run_task", mapped)
    bags = [tmp_path / name for name in ("good", "lost", "other")]
    outcomes = run_many(bags, tmp_path / "out", RunOptions(), Lossy(), lambda *at: told.append(at))
    assert [bool(one.reason) for one in outcomes] == [False, True, False]
    assert told[-1] == (15, 30)
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(outcomes_table(outcomes))
    text = console.export_text()
    assert text.count("failed") == 1
    assert text.count("12.3") == text.count("50%") == 2


def test_a_fault_of_the_program_fails_its_recording_alone(tmp_path, monkeypatch):
    class Broken:
        def __init__(self, bag, output, options):
            raise RuntimeError(f"no {bag.name}")

    monkeypatch.setattr(many_runs, "RecordingRun", Broken)
    bags = [tmp_path / name for name in ("one", "two")]
    outcomes = run_many(bags, tmp_path / "out", RunOptions(), InProcess(), lambda *at: None)
    assert [one.reason for one in outcomes] == ["RuntimeError: no one", "RuntimeError: no two"]


def test_ctrl_c_in_one_process_names_the_recordings_that_are_mapped(tmp_path, monkeypatch):
    class Fake:
        def __init__(self, bag, output, options):
            self.name = bag.name

        def write(self, display):
            if self.name == "third":
                raise KeyboardInterrupt
            if self.name == "second":
                raise ValueError("nothing was mapped")
            return {"failure": "", "degraded": []}, False

    monkeypatch.setattr(many_runs, "RecordingRun", Fake)
    bags = [tmp_path / name for name in ("first", "second", "third")]
    for bag in bags:
        bag.mkdir()
    done = call("run", *bags, "-o", tmp_path / "out", "--workers", 0)
    assert done.exit_code == INTERRUPTED
    assert "holds the results of: first\n" in done.stderr


def test_paths_of_a_task_do_not_depend_on_the_workers_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = []
    monkeypatch.setattr(
        many_runs, "run_task", lambda task, *_: given.append(task) or RunOutcome(task.bag, task.output, {})
    )
    run_many([Path("a"), Path("b")], Path("out"), RunOptions(old_map=Path("old")), InProcess(), lambda *at: None)
    assert [task.options.old_map for task in given] == [tmp_path / "old"] * 2
    assert [task.output for task in given] == [tmp_path / "out" / "a", tmp_path / "out" / "b"]


def test_workers_for_one_recording_are_refused(tmp_path):
    done = call("run", DEMO, "-o", tmp_path / "out", "--workers", 2)
    assert "several recordings" in str(done.exception)
    done = call("run", DEMO, DEMO, "-o", tmp_path / "out")
    assert "named twice" in str(done.exception)
    assert not (tmp_path / "out").exists()
