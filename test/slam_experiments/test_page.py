# SPDX-License-Identifier: Apache-2.0
"""docs/experiments.md is what one run of ``slam experiment all`` has found, as docs/experiments.json holds it."""

from __future__ import annotations

import json
from pathlib import Path

from slam_experiments.answers import answers
from slam_experiments.catalogue import EXPERIMENTS
from slam_experiments.page import write_markdown
from slam_experiments.simulated.expected import expected

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = json.loads((DOCS / "experiments.json").read_text())


NAMES = [entry["name"] for entry in PAGE]
FIGURES = {
    "planar": ["6.5", "6.6"], "detectors": ["3.3"], "tof_features": ["3.5"], "association": ["4.5", "4.9"],
    "workshop_rig": ["9.3", "9.4"], "dense_model": ["9.6"], "sweep": ["9.13", "9.14"],
    "one_filter": ["6.4", "9.17", "9.18"], "figure_eight": ["9.19", "9.23"], "five_rooms": ["9.21"],
    "workshop_joined": ["9.26"], "modes": ["11.1"], "scan_trajectory": ["10.7"],
    "registration": [f"10.{k}" for k in (1, 2, 3, 4, 6, *range(8, 18))],
}  # fmt: skip
"""Figures of chapters 3, 4, 6 and 9 to 11 by experiment; 10.5 is a photograph."""


def test_the_documentations_page_is_what_was_found(tmp_path):
    assert [name for name in EXPERIMENTS if name in NAMES] == NAMES
    assert not any(entry["quick"] for entry in PAGE)
    write_markdown(tmp_path / "page.md", PAGE)
    assert (tmp_path / "page.md").read_text() == (DOCS / "experiments.md").read_text()


def test_answers_stand_on_the_page():
    found = answers({entry["name"]: entry for entry in PAGE})
    assert len(found) >= 4
    assert all(answer["answer"] in (DOCS / "experiments.md").read_text() for answer in found)


def test_every_figure_of_the_thesis_is_drawn():
    for entry in PAGE:
        drawn = {n for picture in entry["pictures"] for n in picture["number"].split(", ")}
        assert set(FIGURES.get(entry["name"], ())) <= drawn, entry["name"]


def test_every_scenario_is_held_to_its_bounds():
    """Those too long for a test, at full length: the page says of each whether it keeps bags/expected.yaml."""
    judged = {
        c["quantity"].rsplit(", ", 1)[-1]: c["met"]
        for entry in PAGE
        for c in entry["comparisons"]
        if c["quantity"].startswith("bounds of bags/expected.yaml")
    }
    absent = {"firemen_2", "firemen_3"} if "firemen" not in NAMES else set()
    assert set(judged) == set(expected()) - {"demo"} - absent
    assert set(judged.values()) == {True}
