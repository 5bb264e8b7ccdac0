# SPDX-License-Identifier: Apache-2.0
"""A finished run of the demo bag on the page: read back, scrubbed, and refused where it is none."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_viewer.page.finished import FinishedView
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.pictures import BagPictures
from slam_viewer.page.run_folder import RunFolder
from slam_viewer.report.output import write_results

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    asked = iter(range(10_000))
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    out = tmp_path_factory.mktemp("run")
    result, session = run_bag(DEMO, config, stopped=lambda: next(asked) == 60)
    write_results(out, result, lambda path: session.save(path).result())
    return out


def test_a_run_is_read_back_with_its_covariances_model_and_plan(folder):
    run = RunFolder.read(folder)
    trajectory = run.trajectories[""]
    assert trajectory.covariances is not None
    assert len(trajectory) > 10
    assert len(run.map.landmarks().positions) == run.summary["landmarks"]
    first, last = run.span_ns
    assert last > first
    assert len(run.submap_lines()) == run.summary["submaps"]
    assert len(run.submap_lines(first)) == 0


def test_the_time_line_shows_less_of_the_way_the_earlier_it_is(folder):
    run = RunFolder.read(folder)
    page = ViewerPage(0)
    try:
        view = FinishedView(page, run, BagPictures(run, DEMO).at)
        shown: list[np.ndarray] = []
        page.show_trajectory = lambda index, poses, layer="": shown.append(poses)  # type: ignore[method-assign]
        assert len(str(view.slider.max)) <= 5  # the box shows all its digits
        first, last = run.span_ns
        view.show_until(last)
        view.show_until((first + last) // 2)
        assert len(shown[0]) == len(run.trajectories[""])
        assert 0 < len(shown[1]) < len(shown[0])
    finally:
        page.stop()


def test_pictures_are_those_of_the_moment(folder):
    run = RunFolder.read(folder)
    pictures = BagPictures(run, DEMO)
    first, last = run.span_ns
    early, late = pictures.at("", first), pictures.at("", last)
    assert early is not None
    assert late is not None
    assert early.image.ndim == 3
    assert not np.array_equal(early.image, late.image)
    assert pictures.at("", first - 10**9) is None


def test_a_run_whose_map_is_of_another_version_is_shown_without_it(folder, tmp_path):
    copy = tmp_path / "old"
    shutil.copytree(folder, copy)
    manifest = copy / "map" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"version": ', '"version": 9'))
    run = RunFolder.read(copy)
    assert "version" in run.note
    assert len(run.trajectories[""]) > 10
    page = ViewerPage(0)
    try:
        FinishedView(page, run)
    finally:
        page.stop()


def test_a_folder_without_a_run_is_refused_with_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="no finished run"):
        RunFolder.read(tmp_path)
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        RunFolder.read(tmp_path)
