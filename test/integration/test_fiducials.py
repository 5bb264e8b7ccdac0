# SPDX-License-Identifier: Apache-2.0
"""The page about tags does as typed; nodes find the same tags; a second run goes on in the first one's frame."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
import yaml

from demo_parts import call

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
TAGS = ["--tags", "apriltag_36h11", "--tag-size", "0.2"]
SHIFT = np.array([10.0, -20.0, 3.0])


def slam(folder: Path, *words: str) -> None:
    with chdir(folder):
        done = call(*words)
    assert done.exit_code == 0, f"{words}: {done.output}{done.exception}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the page's first two commands have run: those of the corridor with a tag."""
    folder = tmp_path_factory.mktemp("fiducials")
    lines = re.findall(r"^\./slam ((?:simulate|run) .*)$", (ROOT / "docs/fiducials.md").read_text(), flags=re.M)
    assert len(lines) == 2
    for line in lines:
        slam(folder, *shlex.split(line))
    return folder


def tags(out: Path) -> dict[int, np.ndarray]:
    return {row["id"]: np.array(row["position"]) for row in yaml.safe_load((out / "tags.yaml").read_text())["tags"]}


def test_the_tag_is_where_the_scenario_hangs_it(folder: Path) -> None:
    summary = json.loads((folder / "out/tagged/summary.json").read_text())
    assert summary["tags"]["in_more_than_one_place"] == []
    truth = np.loadtxt(folder / "out/tagged/ground_truth.tum")[0]
    found = tags(folder / "out/tagged")
    assert 1 in found
    distance = np.linalg.norm(np.array([3.4, 2.396, 1.4]) - truth[1:4])
    assert abs(np.linalg.norm(found[1]) - distance) < 0.05


def test_known_tags_move_the_map(folder: Path) -> None:
    path = folder / "out/tagged/tags.yaml"
    content = yaml.safe_load(path.read_text())
    for row in content["tags"]:
        row["position"] = (np.array(row["position"]) + SHIFT).tolist()
    (folder / "known.yaml").write_text(yaml.safe_dump(content))
    slam(folder, "run", "out/corridor", "-o", "out/anchored", *TAGS, "--known-tags", "known.yaml")
    summary = json.loads((folder / "out/anchored/summary.json").read_text())
    assert summary["tags"]["is_in_building_frame"]
    first, moved = (np.loadtxt(folder / "out" / name / "trajectory.tum")[:, 1:4] for name in ("tagged", "anchored"))
    assert np.abs(moved - first - SHIFT).max() < 0.15


def test_nodes_find_the_same_tags(folder: Path) -> None:
    slam(folder, "nodes", "out/corridor", "-o", "out/nodes", "--composed", *TAGS)
    offline, online = tags(folder / "out/tagged"), tags(folder / "out/nodes")
    assert offline.keys() == online.keys()
    for number, position in offline.items():
        np.testing.assert_allclose(online[number], position, atol=0.02)
