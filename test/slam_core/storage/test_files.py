# SPDX-License-Identifier: Apache-2.0
"""Files are whole or absent, and no folder is removed that is not known to be ours."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from slam_core.storage.files import PathLock, atomic_path, atomic_text, read_bytes, read_json, read_yaml
from slam_core.storage.output_file import OutputFile


def make_folder(path: Path, name: str = "a") -> None:
    path.mkdir()
    (path / name).write_text(name)


def test_a_failure_keeps_what_was_there(tmp_path: Path) -> None:
    atomic_text(tmp_path / "a", "old")

    def fail() -> None:
        with atomic_path(tmp_path / "a") as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_a_file_never_takes_the_place_of_a_folder(tmp_path: Path) -> None:
    make_folder(tmp_path / "mine")
    (tmp_path / "empty").mkdir()
    for name in ("mine", "empty"):
        with pytest.raises(ValueError, match="folder"):
            atomic_text(tmp_path / name, "text")
    assert (tmp_path / "mine" / "a").read_text() == "a"


def test_a_folder_replaces_only_what_is_said_to_be_ours(tmp_path: Path) -> None:
    make_folder(tmp_path / "mine")

    def write(path: Path, ours: bool) -> None:
        with atomic_path(path, may_replace=lambda _: ours) as temporary:
            make_folder(temporary, "b")

    with pytest.raises(ValueError, match="would be lost"):
        write(tmp_path / "mine", ours=False)
    assert (tmp_path / "mine" / "a").exists()
    write(tmp_path / "mine", ours=True)
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["b"]
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_results_file_replaces_its_own_kind_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    OutputFile(path, "evaluate", "x").write({"ate": 1.0})
    OutputFile(path, "evaluate", "x").write({"ate": 2.0})
    with pytest.raises(ValueError, match=r"holds the results of 'slam evaluate x'.*--overwrite"):
        OutputFile(path, "evaluate", "y")
    OutputFile(path, "evaluate", "y", overwrite=True).write({})
    for foreign in ("{}", "mine", "[]", '{"written_by": {"program": "other"}}'):
        path.write_text(foreign)
        with pytest.raises(ValueError, match="not written by slam"):
            OutputFile(path, "evaluate", "y", overwrite=True)
        assert path.read_text() == foreign


def test_only_files_of_a_size_that_can_be_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name, why in (("pipe", "a pipe or a device"), ("zero", "a pipe or a device"), (".", "a folder")):
        with pytest.raises(ValueError, match=why):
            read_bytes(tmp_path / name)
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", at_most=5) == b"12345"
    with pytest.raises(ValueError, match="5 bytes, more than the 4"):
        read_bytes(tmp_path / "a", at_most=4)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "absent")


def test_json_and_yaml_that_are_none_or_nested_too_deeply_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for text, read, why in (
        ("[" * 10**5, read_json, "nested too deeply"),
        ("[" * 10**4, read_yaml, "nested too deeply"),
        ("{", read_json, "not JSON"),
        ("{a: ]", read_yaml, "not YAML"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=why):
            read(path)
    path.write_text('{"a": [1]}')
    assert read_json(path) == read_yaml(path) == {"a": [1]}


def test_a_path_is_kept_for_one_until_it_is_released(tmp_path: Path) -> None:
    lock = PathLock(tmp_path / "new" / "map")
    with pytest.raises(ValueError, match=f"in use by another process, number {os.getpid()}"):
        PathLock(tmp_path / "new" / "map")
    PathLock(tmp_path / "new" / "other").release()
    lock.release()
    lock.release()
    assert list((tmp_path / "new").iterdir()) == []
    PathLock(tmp_path / "new" / "map").release()
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="cannot be written"):
        PathLock(tmp_path / "file" / "map")


def test_a_full_disk_is_told_with_the_file_and_nothing_half_written_stays(
    tmp_path: Path, full_disk: Callable[[], AbstractContextManager[None]]
) -> None:
    with full_disk(), pytest.raises(OSError, match=re.escape(str(tmp_path / "a"))):
        atomic_text(tmp_path / "a", "x" * 10**6)
    assert list(tmp_path.iterdir()) == []
