# SPDX-License-Identifier: Apache-2.0
"""The page about positions does as typed: they bound the drift, outliers are refused, and the building is found."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slam_core.geometry import boxminus, transform_from_pose7
from slam_core.storage.anchor_file import read_anchor
from slam_simulation import Scenario
from slam_simulation.sensors.position import T_BUILDING_WORLD, PositionSensor

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


def slam(folder: Path, *words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "slam_bringup.cli", *words], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("positions")
    page = (ROOT / "docs/positions.md").read_text()
    lines, (block,) = (
        re.findall(r"^\./slam (.*)$", page, flags=re.M),
        re.findall(r"```yaml\n(.*?)```", page, flags=re.S),
    )
    (folder / "positions.yaml").write_text(block)
    assert [line.split()[0] for line in lines] == ["simulate", "run"]
    for line in lines:
        slam(folder, *shlex.split(line))
    (folder / "off.yaml").write_text('sjsam: {position: {use: "off"}}\n')
    slam(folder, "run", "out/uwb", "-o", "out/without", "--config", "off.yaml")
    return folder


def summary(folder: Path, name: str) -> dict[str, object]:
    found: dict[str, object] = json.loads((folder / "out" / name / "summary.json").read_text())
    return found


def test_positions_bound_the_drift(folder: Path) -> None:
    with_them, without = summary(folder, "positions"), summary(folder, "without")
    assert with_them["ate_rmse_m"] < 0.75 * without["ate_rmse_m"]  # type: ignore[operator]
    assert "position" not in str(without["rejections"])
    assert not (folder / "out/without/anchor.yaml").exists()


def test_outliers_are_refused_and_others_are_not(folder: Path) -> None:
    scenario = Scenario.load("corridor_with_positions")
    sensor = PositionSensor(scenario.suite.position, scenario.path(), (scenario.seed, 11, 0))
    counts = summary(folder, "positions")["rejections"]
    assert isinstance(counts, dict)
    heard = counts["positions_used"] + counts["positions_refused"]
    assert heard > 40
    assert counts["positions_refused"] / heard == pytest.approx(sensor.is_outlier.mean(), abs=0.08)


def test_the_building_is_where_the_simulation_has_it(folder: Path) -> None:
    anchor = read_anchor(folder / "out/positions/anchor.yaml")
    first = np.loadtxt(folder / "out/positions/ground_truth.tum")[0]
    error = boxminus(anchor.T, T_BUILDING_WORLD @ transform_from_pose7(first[1:8]))
    assert np.linalg.norm(error[:3]) < 0.3
    assert np.linalg.norm(error[3:]) < 0.03
