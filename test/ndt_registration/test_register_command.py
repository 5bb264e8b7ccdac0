# SPDX-License-Identifier: Apache-2.0
"""``slam register`` on small files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bringup.commands.register import command
from slam_core.geometry import FloatArray, boxminus

KEYS = {
    "T_target_source", "covariance", "converged", "iterations", "score", "overlap", "inlier_rmse", "degenerate",
    "reason",
}  # fmt: skip


def write_pcd(path: Path, points: FloatArray) -> Path:
    fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1"
    size = f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    path.write_bytes(f"VERSION 0.7\n{fields}\n{size}".encode() + points.astype("<f4").tobytes())
    return path


def write_ply(path: Path, points: FloatArray) -> Path:
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{columns}end_header\n"
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())
    return path


TRUTH = (0.1, 0.05, 0.0, 4.0)


@pytest.fixture
def clouds(tmp_path: Path, room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> tuple[str, str]:
    """Files of a source and a target."""
    rng = np.random.default_rng(5)
    source = write_pcd(tmp_path / "source.pcd", room.scan(start @ at(*TRUTH), rng, 60))
    return str(source), str(write_ply(tmp_path / "target.ply", room.scan(start, rng, 60)))


@pytest.mark.parametrize("guess", [(), ("--initial-guess", "0.1 0 0 3 0 0")])
def test_prints_one_json_object(clouds: tuple[str, str], at: Callable[..., FloatArray], guess: tuple[str, ...]) -> None:
    outcome = CliRunner().invoke(command, [*clouds, *guess], catch_exceptions=False)
    result = json.loads(outcome.stdout)
    assert outcome.exit_code == 0
    assert set(result) == KEYS
    assert result["converged"], result["reason"]
    assert np.shape(result["covariance"]) == (6, 6)
    assert np.abs(boxminus(np.array(result["T_target_source"]), at(*TRUTH))).max() < 0.02


def test_writes_result_and_picture(clouds: tuple[str, str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    outcome = CliRunner().invoke(command, [*clouds, "-o", str(out)], catch_exceptions=False)
    assert json.loads((out / "result.json").read_text()) == json.loads(outcome.stdout)
    assert (out / "registration.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in out.iterdir()) == [".slam.json", "registration.png", "result.json"]


@pytest.mark.parametrize(
    ("unit", "guess", "advice"),
    [
        (1000.0, (), "are both in metres?"),
        (1.0, (), "give --initial-guess; the search went as far as 0.6 times"),
        (1.0, ("--initial-guess", "0 0 0"), "Try without --initial-guess"),
    ],
)
def test_a_failure_says_what_to_try(
    clouds: tuple[str, str], tmp_path: Path, unit: float, guess: tuple[str, ...], advice: str
) -> None:
    noise = unit * np.random.default_rng(5).normal(size=(2000, 3))
    source = write_pcd(tmp_path / "noise.pcd", noise)
    outcome = CliRunner().invoke(command, [str(source), clouds[1], *guess], catch_exceptions=False)
    assert not json.loads(outcome.stdout)["converged"]
    assert "not registered: " in outcome.stderr
    assert advice in outcome.stderr


@pytest.mark.parametrize(
    ("guess", "message"),
    [("1 2", "3, 6, 7 or 16 numbers, got 2"), ("far away", "neither numbers nor a file"), ("nan 0 0", "finite")],
)
def test_a_bad_guess_is_a_clear_error(clouds: tuple[str, str], guess: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CliRunner().invoke(command, [*clouds, "--initial-guess", guess], catch_exceptions=False)


def test_bad_files_are_clear_errors(clouds: tuple[str, str], tmp_path: Path) -> None:
    empty = write_pcd(tmp_path / "empty.pcd", np.full((5, 3), np.nan))
    text = tmp_path / "cloud.txt"
    text.write_text("1 2 3")
    for bad, message in ((empty, "no finite points"), (text, "cloud.txt"), (tmp_path / "none.pcd", "none.pcd")):
        with pytest.raises((ValueError, OSError), match=message):
            CliRunner().invoke(command, [str(bad), clouds[1]], catch_exceptions=False)
