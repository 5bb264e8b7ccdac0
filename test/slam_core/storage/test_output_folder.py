# SPDX-License-Identifier: Apache-2.0
"""What is not ours survives everything; what is ours is whole, also when the program is killed at any step."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from slam_core.storage.output_folder import MANIFEST, OutputFolder, free_name

SOURCES = Path(__file__).resolve().parents[2] / "src" / "slam_core"


def write(path: Path, files: dict[str, str], command: str = "run", source: str = "bag", **options: bool) -> None:
    with OutputFolder(path, command, source, **options) as output, output.staged() as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)


def give_up(output: OutputFolder, files: dict[str, str]) -> None:
    with output, output.staged(rescue="map") as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        raise KeyboardInterrupt


def given_up(path: Path, files: dict[str, str]) -> Path | None:
    output = OutputFolder(path, "run", "bag")
    with pytest.raises(KeyboardInterrupt):
        give_up(output, files)
    return output.rescued


def content(path: Path) -> dict[str, str]:
    files = sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith(".slam."))
    return {str(p.relative_to(path)): p.read_text() for p in files}


OLD = {"summary.json": "1", "map/arrays": "1", "old.txt": "1"}
NEW = {"summary.json": "2", "map/arrays": "2", "new.txt": "2"}


def test_the_same_command_on_the_same_source_replaces_its_results(tmp_path: Path) -> None:
    write(tmp_path / "out", OLD)
    (tmp_path / "out" / "map" / "notes.txt").write_text("mine")
    write(tmp_path / "out", NEW)
    assert content(tmp_path / "out") == {**NEW, "map/notes.txt": "mine"}


def test_a_folder_with_other_files_is_refused_even_with_overwrite(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=r"files that slam did not write \(thesis.tex\): choose another folder"):
            write(tmp_path, NEW, overwrite=overwrite)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(ValueError, match="is a file"):
        write(tmp_path / "out", NEW, overwrite=True)


@pytest.mark.parametrize(("command", "source"), [("nodes", "bag"), ("run", "other")])
def test_other_results_of_ours_need_overwrite(tmp_path: Path, command: str, source: str) -> None:
    write(tmp_path / "out", OLD)
    with pytest.raises(ValueError, match=r"holds the results of 'slam run bag'.*--overwrite"):
        write(tmp_path / "out", NEW, command, source)
    assert content(tmp_path / "out") == OLD
    write(tmp_path / "out", NEW, command, source, overwrite=True)
    assert content(tmp_path / "out") == NEW


@pytest.mark.parametrize("replaced_by_link", [False, True])
def test_results_that_were_changed_need_overwrite(tmp_path: Path, replaced_by_link: bool) -> None:
    write(tmp_path / "out", OLD)
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "out" / "old.txt").unlink()
    if replaced_by_link:
        (tmp_path / "out" / "old.txt").symlink_to(tmp_path / "mine.txt")
    else:
        (tmp_path / "out" / "old.txt").write_text("edited")
    with pytest.raises(ValueError, match=r"changed since \(old.txt\)"):
        write(tmp_path / "out", NEW)
    write(tmp_path / "out", NEW, overwrite=True)
    assert content(tmp_path / "out") == NEW
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_users_file_of_a_new_name_stays_and_the_results_are_kept_beside(tmp_path: Path) -> None:
    write(tmp_path / "out", OLD)
    (tmp_path / "out" / "new.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"new.txt was not written by slam and stays: the results are in .*results"):
        write(tmp_path / "out", NEW)
    assert (tmp_path / "out" / "new.txt").read_text() == "mine"
    assert content(tmp_path / "out" / "results") == NEW
    assert content(tmp_path / "out")["summary.json"] == "1"


def test_a_list_that_names_files_elsewhere_or_is_damaged_is_refused(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    write(tmp_path / "out", OLD)
    for files in ({"../victim": []}, {str(victim): []}, ["victim"]):
        forged = {"program": "slam", "command": "run", "source": "bag", "files": files}
        (tmp_path / "out" / MANIFEST).write_text(json.dumps(forged))
        with pytest.raises(ValueError, match="choose another"):
            write(tmp_path / "out", NEW, overwrite=True)
    assert victim.read_text() == "mine"


def test_a_linked_subfolder_is_never_followed(tmp_path: Path) -> None:
    write(tmp_path / "out", OLD)
    (tmp_path / "out" / "map" / "arrays").rename(tmp_path / "arrays")
    (tmp_path / "out" / "map").rmdir()
    (tmp_path / "out" / "map").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="was not written by slam and stays"):
        write(tmp_path / "out", NEW, overwrite=True)
    assert (tmp_path / "arrays").read_text() == "1"


def test_a_failure_leaves_no_folder_but_the_old_results_and_logs(tmp_path: Path) -> None:
    def fail(path: Path, log: bool = False) -> None:
        with OutputFolder(path, "run", "bag") as output, output.staged() as folder:
            if log:
                (output.logs / "node.log").write_text("why")
            (folder / "summary.json").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(RuntimeError):
        fail(tmp_path / "out", log=True)
    assert content(tmp_path / "out") == {"logs/node.log": "why"}
    write(tmp_path / "out", OLD)
    assert content(tmp_path / "out") == OLD
    with pytest.raises(RuntimeError):
        fail(tmp_path / "out")
    assert content(tmp_path / "out") == OLD


@pytest.mark.parametrize("is_second_to_fail", [False, True])
def test_two_workers_at_one_folder_do_not_touch_what_the_other_makes_ready(
    tmp_path: Path, is_second_to_fail: bool
) -> None:
    """As a worker that a cluster lost, and the one that was given its recording again; ids are equal across hosts."""
    out = tmp_path / "out"
    first, second = OutputFolder(out, "run", "bag"), OutputFolder(out, "run", "bag")
    with pytest.raises(RuntimeError) if is_second_to_fail else nullcontext(), second, second.staged() as folder:
        (folder / "summary.json").write_text("same")
        with first, first.staged() as other:
            assert sorted(p.name for p in folder.iterdir()) == ["summary.json"]
            for name in ("summary.json", "first.txt"):
                (other / name).write_text("same")
        assert {"summary.json": "same", "first.txt": "same"}.items() <= content(out).items()
        if is_second_to_fail:
            raise RuntimeError
    kept = {"first.txt": "same"} if is_second_to_fail else {}
    assert content(out) == {"summary.json": "same"} | kept
    write(out, NEW)  # all that is there is known as ours
    assert content(out) == NEW


def test_what_a_worker_of_another_machine_makes_ready_is_not_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    there, here, old = (
        tmp_path / f".slam.{ended.pid}{end}.part" for end in (".1.another", f".1.{socket.gethostname()}", "")
    )
    for folder in (there, here, old):
        folder.mkdir()
    write(tmp_path, NEW)
    assert there.is_dir()
    assert not here.exists()
    assert not old.exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from slam_core.storage.output_folder import OutputFolder
steps = int(sys.argv[2])
def counted(function):
    def call(*arguments, **options):
        global steps
        steps -= 1
        if steps < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call
os.replace, os.unlink, os.mkdir = counted(os.replace), counted(os.unlink), counted(os.mkdir)
with OutputFolder(Path(sys.argv[1]), "run", "bag") as output, output.staged() as folder:
    (folder / "map").mkdir()
    for name in ("summary.json", "map/arrays", "new.txt"):
        (folder / name).write_text("2")
"""


@pytest.mark.parametrize("first", [True, False])
def test_killed_at_any_step_it_is_whole_or_says_that_it_is_not_and_the_next_run_mends_it(
    tmp_path: Path, first: bool
) -> None:
    killed, steps = True, 0
    while killed:
        out = tmp_path / str(steps)
        if not first:
            write(out, OLD)
            (out / "mine.txt").write_text("mine")
        environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
        run = subprocess.run([sys.executable, "-c", KILLED, str(out), str(steps)], env=environment, check=False)
        killed = run.returncode == -signal.SIGKILL
        found = content(out) if out.exists() else {}
        mine = {} if first else {"mine.txt": "mine"}
        complete = {k: v for k, v in found.items() if k in OLD | NEW}
        assert "summary.json" not in found or complete in (OLD, NEW), (steps, found)
        assert mine.items() <= found.items()
        write(out, NEW)
        assert content(out) == NEW | mine
        steps += 1
    assert run.returncode == 0
    assert steps > 8


def test_free_names_are_counted(tmp_path: Path) -> None:
    assert free_name(tmp_path / "a.mcap").name == "a.mcap"
    for name in ("a.mcap", "a_1.mcap"):
        (tmp_path / name).touch()
    assert free_name(tmp_path / "a.mcap").name == "a_2.mcap"


def test_who_gives_up_keeps_the_map_alone_and_old_results_as_they_were(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert given_up(out, {"trajectory.tum": "2", "map/arrays": "2"}) == out / "map"
    assert content(out) == {"map/arrays": "2"}
    write(out, OLD)  # the map is known as ours
    assert content(out) == OLD
    assert given_up(out, {"map/arrays": "3"}) == out / "map_1"
    assert content(out) == {**OLD, "map_1/arrays": "3"}
    assert given_up(tmp_path / "new", {"trajectory.tum": "2"}) is None
    assert not (tmp_path / "new").exists()
