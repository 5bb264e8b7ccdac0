# SPDX-License-Identifier: Apache-2.0
"""No command removes or replaces what it did not write: one clear line, exit code 2, and every byte still there."""

from __future__ import annotations

import gc
import hashlib
import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from slam_bringup.cli import main
from slam_core.point_cloud import write_ply

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "bags" / "demo"


@dataclass(frozen=True)
class Ended:
    returncode: int
    stderr: str


def slam(*arguments: object, home: Path | None = None) -> Ended:
    """How the program ends, in this process: to load it takes longer than most of these commands do."""
    place = {"HOME": str(home)} if home else {}
    with (
        patch.object(sys, "argv", ["slam", *map(str, arguments)]),
        patch.dict(os.environ, place),
        redirect_stderr(io.StringIO()) as said,
        redirect_stdout(io.StringIO()),
        pytest.raises(SystemExit) as end,
    ):
        main()
    gc.enable()
    return Ended(int(end.value.code or 0), said.getvalue())


def snapshot(folder: Path) -> dict[str, str]:
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """Clouds, trajectories and one submap, small enough for the commands to be quick."""
    rng = np.random.default_rng(1)
    folder = tmp_path / "inputs"
    folder.mkdir()
    cloud = rng.uniform(0, 3, (400, 3)).astype(np.float32)
    for name in ("a", "b"):
        write_ply(folder / f"{name}.ply", cloud)
        (folder / f"{name}.tum").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(5)))
    return folder


def commands(inputs: Path, out: Path) -> dict[str, tuple[object, ...]]:
    return {
        "run": ("run", DEMO, "-o", out),
        "nodes": ("nodes", DEMO, "-o", out),
        "record": ("record", "-o", out),
        "simulate": ("simulate", "tof_grid", "-o", out),
        "convert": ("convert", "kitti", inputs, "-o", out),
        "join": ("join", inputs, "-o", out),
        "register": ("register", inputs / "a.ply", inputs / "b.ply", "-o", out),
        "calibrate": ("calibrate", "mono", inputs / "*.png", "--board", "chessboard:9x6:0.025", "-o", out),
    }


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["run", "nodes", "record", "simulate", "convert", "join", "register", "calibrate"])
def test_a_foreign_folder_is_refused_and_stays(tmp_path: Path, inputs: Path, name: str, overwrite: bool) -> None:
    out = tmp_path / "home"
    (out / "map").mkdir(parents=True)
    (out / "map" / "thesis.tex").write_text("years")
    (out / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    before = snapshot(tmp_path)
    result = slam(*commands(inputs, out)[name], *["--overwrite"] * overwrite)
    assert result.returncode == 2, result.stderr
    assert "choose another" in result.stderr
    assert "Traceback" not in result.stderr
    assert snapshot(tmp_path) == before


def test_a_foreign_file_is_refused_and_stays(tmp_path: Path, inputs: Path) -> None:
    out = tmp_path / "notes.json"
    out.write_text("{}")
    for overwrite in ([], ["--overwrite"]):
        result = slam("evaluate", inputs / "a.tum", inputs / "b.tum", "-o", out, *overwrite)
        assert (result.returncode, out.read_text()) == (2, "{}")
        assert "choose another name" in result.stderr


def test_the_same_command_runs_twice_and_other_results_need_overwrite(tmp_path: Path, inputs: Path) -> None:
    out = tmp_path / "out"
    there = ("register", inputs / "a.ply", inputs / "b.ply", "-o", out)
    back = ("register", inputs / "b.ply", inputs / "a.ply", "-o", out)
    for arguments, code in ((there, 0), (there, 0), (back, 2), ((*back, "--overwrite"), 0)):
        result = slam(*arguments)
        assert result.returncode == code, result.stderr
    file = tmp_path / "figures.json"
    for pair, code in (("ab", 0), ("ab", 0), ("ba", 2)):
        result = slam("evaluate", *(inputs / f"{name}.tum" for name in pair), "-o", file)
        assert result.returncode == code, result.stderr


def test_the_home_folder_may_be_written_as_a_tilde(tmp_path: Path, inputs: Path) -> None:
    result = slam("evaluate", "~/inputs/a.tum", inputs / "b.tum", "--output=~/figures.json", home=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "figures.json").exists()
