# SPDX-License-Identifier: Apache-2.0
"""``slam merge``: maps and bags become one map that everything reads, the same with any number of workers."""

from __future__ import annotations

from pathlib import Path

import pytest

from demo_parts import DEMO, call, cut
from mapping import quick_options
from sjsam_node.map_file import storage
from slam_bringup.jobs.merged_run import map_of_bag
from slam_bringup.pipeline.overrides import Overrides
from slam_viewer.page.run_folder import RunFolder


@pytest.fixture(scope="module")
def days(tmp_path_factory) -> tuple[Path, Path]:
    """The finished run of the first part of the demo, and the bag of the second."""
    folder = tmp_path_factory.mktemp("days")
    done = call("run", cut(folder / "first.mcap", 0.0, 0.5), "-o", folder / "first", *quick_options(folder))
    assert done.exit_code == 0, done.output
    return folder / "first", cut(folder / "second.mcap", 0.3, 0.8)


def map_bytes(out: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in (out / "map").iterdir()} | {
        name: (out / name).read_bytes() for name in ("trajectory.tum", "landmarks.ply", "trajectory_covariance.csv")
    }


@pytest.mark.slow
def test_a_map_and_a_bag_become_one_map_of_the_same_bytes_with_any_number_of_workers(days, tmp_path):
    pytest.importorskip("distributed")
    one = call("merge", *days, "-o", tmp_path / "one", "--workers", 0)
    assert one.exit_code == 0, one.output
    assert "separate parts" not in one.output
    two = call("merge", *reversed(days), "-o", tmp_path / "two", "--workers", 2)
    assert two.exit_code == 0, two.output
    assert map_bytes(tmp_path / "one") == map_bytes(tmp_path / "two")
    run = RunFolder.read(tmp_path / "one")
    first, second = (len(storage.read(p).state.graph.records) for p in (days[0] / "map", tmp_path / "one" / "map"))
    assert second > first
    assert len(run.map) == second == run.summary["submaps"]
    assert run.map.components == 1
    again = call("run", days[1], "-o", tmp_path / "again", "--map", tmp_path / "one", *quick_options(tmp_path))
    assert again.exit_code == 0, again.output


@pytest.mark.slow
def test_a_bag_is_mapped_as_slam_run_maps_it(days, tmp_path):
    done = call("run", days[1], "-o", tmp_path / "second")
    assert done.exit_code == 0, done.output
    mapped = storage.pack(map_of_bag(days[1], Overrides()).stored)
    of_run = storage.pack(storage.read(tmp_path / "second" / "map"))
    assert mapped.manifest == of_run.manifest
    assert {n: v.tobytes() for n, v in mapped.arrays.items()} == {n: v.tobytes() for n, v in of_run.arrays.items()}


def test_bad_arguments_are_refused_in_one_line_and_leave_nothing(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "map").mkdir()
    for arguments, said in (
        ((DEMO, "--workers", 2, "--scheduler", "tcp://127.0.0.1:1"), "not both"),
        ((tmp_path / "run", "--workers", 0), "is not a map of this program"),
        ((Path(__file__), "--workers", 0), "test_merge.py"),
    ):
        done = call("merge", *arguments, "-o", tmp_path / "out")
        assert isinstance(done.exception, ValueError | OSError), done.output
        assert said in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_scheduler_that_does_not_answer_is_named(tmp_path):
    pytest.importorskip("distributed")
    done = call("merge", DEMO, "-o", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert isinstance(done.exception, ValueError), done.output
    assert "no Dask scheduler answers at tcp://127.0.0.1:1" in str(done.exception)
