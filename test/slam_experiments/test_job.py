# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import slam_simulation
from slam_experiments.job import Job, _files_of, execute, in_order, load
from slam_experiments.runner import run_jobs

HERE = "slam_experiments.experiments.planar"


def drive(runs: int = 1, known: bool = True) -> Job:
    return Job(f"{HERE}:monte_carlo", {"sigma_bearing": 0.01, "known": known, "runs": runs}, ("slam_core",))


def test_a_result_is_kept_and_used_again(tmp_path):
    folder = execute(drive(), tmp_path)
    written = (folder / "result.json").stat().st_mtime_ns
    assert execute(drive(), tmp_path) == folder
    assert (folder / "result.json").stat().st_mtime_ns == written
    assert load(folder).arrays["nees"].shape == (1,)


def test_the_name_follows_arguments_packages_and_what_came_before():
    digests = {
        drive().digest,
        drive(2).digest,
        Job(drive().function, drive().arguments, ("slam_core", "slam_simulation")).digest,
        Job(drive().function, drive().arguments, ("slam_core",), after=(drive(2),)).digest,
    }
    assert len(digests) == 4
    assert drive().digest == drive().digest


def test_the_name_follows_the_source(monkeypatch):
    from slam_experiments import job

    before = drive().digest
    true_source = job._source_of
    monkeypatch.setattr(job, "_source_of", lambda name: true_source(name) + ("changed" if name == "slam_core" else ""))
    assert drive().digest != before


def test_the_name_follows_the_scenarios():
    """They lie behind a link, which Path.rglob does not follow."""
    files = _files_of(Path(slam_simulation.__file__).parent)
    assert {"demo.yaml", "scenario.py"} <= {path.name for path in files}


def test_an_unknown_package_is_named():
    with pytest.raises(ValueError, match="no_such_package"):
        Job(drive().function, {}, ("no_such_package",)).digest  # noqa: B018


def test_jobs_come_after_what_they_build_on_and_once():
    first, second = drive(1), drive(2)
    third = Job(first.function, {"x": 3}, ("slam_core",), after=(first, second))
    fourth = Job(first.function, {"x": 4}, ("slam_core",), after=(third, first))
    assert [j.digest for j in in_order([fourth, third])] == [j.digest for j in (first, second, third, fourth)]


def test_a_job_that_fails_leaves_no_result(tmp_path):
    bad = Job(f"{HERE}:monte_carlo", {"sigma_bearing": -1.0, "known": True, "runs": 1}, ("slam_core",))
    with pytest.raises(ValueError, match="sigma_bearing"):
        execute(bad, tmp_path)
    assert not (bad.folder(tmp_path) / "result.json").exists()


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_workers(tmp_path: Path):
    pytest.importorskip("distributed")
    jobs = [drive(2, known) for known in (True, False)]
    one, two = (run_jobs(jobs, tmp_path / str(n), workers=n) for n in (1, 2))
    for job in jobs:
        assert one[job].values == two[job].values
        for name, array in one[job].arrays.items():
            np.testing.assert_array_equal(array, two[job].arrays[name])
