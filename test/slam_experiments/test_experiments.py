# SPDX-License-Identifier: Apache-2.0
"""Every experiment is complete and names what it shows; the quick ones run and mean what they say."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bringup.cli import slam
from slam_experiments.answers import answers
from slam_experiments.catalogue import EXPERIMENTS, chosen
from slam_experiments.experiments.association import METHODS, associate
from slam_experiments.experiments.planar import filter_run, graph_of
from slam_experiments.experiments.registration import register_motions
from slam_experiments.experiments.survey import cost_of_a_step
from slam_experiments.findings import Comparison, Findings, as_json
from slam_experiments.page import write_page
from slam_simulation.planar import PlanarWorldConfig, simulate_planar


def test_every_experiment_says_what_it_needs():
    for experiment in EXPERIMENTS.values():
        for quick in (True, False):
            jobs = experiment.jobs(quick)
            assert jobs
            assert all(re.fullmatch(r"[0-9a-f]{16}", job.digest) for job in jobs.values())
        assert {j.digest for j in experiment.jobs(True).values()} != {j.digest for j in experiment.jobs(False).values()}


def test_no_name_and_an_unknown_one_list_the_experiments_with_their_titles():
    lines = [rf"{e.name} +{re.escape(e.title)}" for e in EXPERIMENTS.values()]
    for names, said in (((), "name experiments"), (("planar", "nonsense"), "no experiment nonsense")):
        with pytest.raises(ValueError, match="(?s)" + ".*".join([said, *lines])):
            chosen(names)
    with pytest.raises(ValueError, match=lines[0]):
        CliRunner().invoke(slam, ["experiment"], catch_exceptions=False)
    assert re.search("(?s)" + ".*".join(lines), CliRunner().invoke(slam, ["experiment", "--help"]).output)
    assert [e.name for e in chosen(("all",))] == list(EXPERIMENTS)
    assert [e.name for e in chosen(("planar", "planar"))] == ["planar"]


@pytest.fixture(scope="module")
def planar_run(tmp_path_factory):
    out = tmp_path_factory.mktemp("experiment")
    result = CliRunner().invoke(slam, ["experiment", "planar", "-o", str(out), "--quick"])
    assert result.exit_code == 0, result.output
    return out, json.loads((out / "experiments.json").read_text())


def test_planar_shows_its_figures_beside_the_thesis(planar_run):
    out, (entry,) = planar_run
    assert {p["number"] for p in entry["pictures"]} >= {"6.5", "6.6"}
    assert all((out / p["file"]).read_bytes().startswith(b"\x89PNG") for p in entry["pictures"])
    assert any("SAM's cost" in c["quantity"] and c["ours"] == "in every run" for c in entry["comparisons"])
    assert all(c["met"] is None for c in entry["comparisons"])  # a quick run is held to no mark


def test_the_page_needs_no_other_file(planar_run):
    out, (entry,) = planar_run
    page = (out / "experiments.html").read_text()
    assert "data:image/png;base64," in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert entry["title"] in page


def test_the_markdown_page_holds_every_comparison(planar_run):
    out, (entry,) = planar_run
    page = (out / "experiments.md").read_text()
    assert all(c["ours"] in page for c in entry["comparisons"])
    assert "slam experiment planar" in page


ENTRIES = {
    "one_filter": {"comparisons": [{"quantity": "time per frame at the end", "ours": "40 ms, with submaps 7 ms"},
                                   {"quantity": "ANEES, one filter and joined submaps", "ours": "1.9, 1.1"}]},
    "survey": {"comparisons": [{"quantity": "growth of a step's time: one EKF, joined submaps", "ours": "n^2, n^0.4"}]},
    "figure_eight": {"comparisons": [{"quantity": "end error", "ours": "2.0 mm"}]},
    "five_rooms": {"comparisons": [{"quantity": "loop", "ours": "9 closures, end error 1.7 mm"}]},
    "sweep": {"tables": [{"header": ["run", "ATE mm"], "rows": [["sweep", "2.0"]]}], "comparisons": []},
    "fireman": {"tables": [{"header": ["run", "ATE mm"], "rows": [["fireman_5hz", "9.0"], ["fireman_10hz", "3.0"]]}],
                "comparisons": [{"quantity": "5hz, looking round", "ours": "lost 0 times"}]},
}  # fmt: skip


def test_questions_are_answered_by_figures_of_what_was_run():
    found = {answer["question"]: answer["answer"] for answer in answers(ENTRIES)}
    assert len(found) == 2  # the others' experiments were not run
    techniques, motion = found.values()
    for figure in ("40 ms, with submaps 7 ms", "1.9, 1.1", "n^2, n^0.4", "2.0 mm", "9 closures"):
        assert figure in techniques
    assert "ATE 2.0 mm in a slow sweep" in motion
    assert "3.0 mm" in motion
    assert "1.5 times" in motion


def test_a_folder_of_others_is_refused(tmp_path):
    (tmp_path / "experiments.html").write_text("mine")
    result = CliRunner().invoke(slam, ["experiment", "planar", "-o", str(tmp_path), "--quick"])
    assert result.exit_code != 0
    assert (tmp_path / "experiments.html").read_text() == "mine"


def test_a_run_that_failed_is_gone_on_with(tmp_path, monkeypatch):
    """What was computed stays in the cache, and the folder stays ours."""

    def fail(*_):
        raise ValueError("no more")

    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr("slam_experiments.commands.experiment.write_page", fail)
        with pytest.raises(ValueError, match="no more"):
            CliRunner().invoke(slam, ["experiment", "planar", "-o", str(out), "--quick"], catch_exceptions=False)
    assert {p.name for p in out.iterdir()} == {".slam.json", "cache"}
    result = CliRunner().invoke(slam, ["experiment", "planar", "-o", str(out), "--quick"], catch_exceptions=False)
    assert result.exit_code == 0
    assert (out / "experiments.html").exists()


def test_an_unmet_mark_is_said(planar_run, tmp_path):
    out, (entry,) = planar_run
    failed = {**entry, "quick": False, "comparisons": [{**entry["comparisons"][0], "met": False}]}
    write_page(out / "failed.html", [failed])
    assert "not met" in (out / "failed.html").read_text()
    assert "0 of 1 marks are met" in (out / "failed.html").read_text()


def test_marks_that_numpy_judged_are_written(tmp_path):
    comparison = Comparison("length", "1", "2", "<= 3", np.array(2.0) <= 3.0)
    for quick, met in ((False, True), (True, None)):
        written = json.loads(json.dumps(as_json(EXPERIMENTS["planar"], Findings([comparison]), tmp_path, quick=quick)))
        assert written["comparisons"][0]["met"] is met


def test_the_smoothers_problem_holds_every_associated_measurement():
    run = simulate_planar(PlanarWorldConfig(samples=20), np.random.default_rng(3))
    _, _, slots = filter_run(run, known=True)
    graph = graph_of(run, slots)
    assert len(graph.measured) == sum(len(o.ids) for o in run.observations)
    assert len(graph.motions) == 19


def test_true_pairs_are_found_and_counted(tmp_path):
    found = {name: associate(tmp_path, [], name, 1, 8)[0] for name in METHODS}
    best = found["Algorithm 2 + descriptors"]
    assert best["precision"] > 0.98
    assert best["recall"] > 0.9
    assert found["Algorithm 1: nearest"]["recall"] < best["recall"]


@pytest.mark.parametrize("technique", ["one_filter", "batch", "submaps"])
def test_every_technique_of_the_survey_maps_the_same_world(tmp_path, technique):
    values, _ = cost_of_a_step(tmp_path, [], technique, 80)
    assert values["rmse_m"] < 0.2
    assert values["seconds"] > 0.0


@pytest.mark.slow
def test_registrations_are_recorded_motion_by_motion(tmp_path):
    values, arrays = register_motions(tmp_path, [], "ndt", 0.2, 1)
    assert values["method"] == "ndt"
    error = arrays["found"] - arrays["true"]
    assert arrays["found"].shape[1:] == (1, 6)
    assert np.median(np.linalg.norm(error[..., :3], axis=-1)) < 0.02
