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
    text = tmp_path / "cloud.obj"
    text.write_text("1 2 3")
    for bad, message in ((empty, "no finite points"), (text, "cloud.obj")):
        with pytest.raises(ValueError, match=message):
            CliRunner().invoke(command, [str(bad), clouds[1]], catch_exceptions=False)


def test_a_missing_file_and_a_folder_are_refused_by_name(clouds: tuple[str, str], tmp_path: Path) -> None:
    for bad in (tmp_path / "none.pcd", tmp_path):
        for files in ([str(bad), clouds[1]], [clouds[0], str(bad)], [*clouds, "--config", str(bad)]):
            outcome = CliRunner().invoke(command, files, catch_exceptions=False)
            assert outcome.exit_code == 2
            assert f"'{bad}' " in outcome.stderr
            assert "Errno" not in outcome.stderr


@pytest.mark.parametrize("method", ["ndt", "icp", "icp_plane"])
def test_a_thin_map_lies_on_itself(tmp_path: Path, method: str) -> None:
    """A map of walls with one point or two in a cell of the usual size, and thinner still at one end."""
    rng = np.random.default_rng(3)
    places = rng.uniform(0.0, 1.0, (3, 900, 2)) ** 1.5 * [6.0, 4.0]
    floor, wall, front = (np.insert(places[k], k, 0.01 * rng.normal(size=900), axis=1) for k in range(3))
    path = str(write_ply(tmp_path / "map.ply", np.add(np.concatenate([floor, wall, front]), [1.0, 1.0, 0.0])))
    outcome = CliRunner().invoke(command, [path, path, "--method", method], catch_exceptions=False)
    result = json.loads(outcome.stdout)
    assert result["converged"], result["reason"]
    assert result["overlap"] > 0.9
    assert np.abs(boxminus(np.array(result["T_target_source"]), np.eye(4))).max() < 0.005


def walls(x: float, y: float, yaw: float, rng: np.random.Generator) -> FloatArray:
    """Ranges (400,) of a laser scanner to the walls of an L-shaped room."""
    corners = np.array([[-2.0, -1.5], [4.0, -1.5], [4.0, 1.0], [1.5, 1.0], [1.5, 3.0], [-2.0, 3.0]])
    angle = yaw + np.linspace(-np.pi, np.pi, 400, endpoint=False)
    ray = np.column_stack([np.cos(angle), np.sin(angle)])
    nearest = np.full(400, np.inf)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, offset = b - a, a - [x, y]
        det = ray[:, 0] * -along[1] + ray[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (offset[0] * -along[1] + offset[1] * along[0]) / det
            share = (ray[:, 0] * offset[1] - ray[:, 1] * offset[0]) / det
        hit = (reach > 0) & (share >= 0) & (share <= 1)
        nearest[hit] = np.minimum(nearest[hit], reach[hit])
    return np.asarray(nearest + 0.005 * rng.standard_normal(400))


def write_scan(path: Path, ranges: FloatArray) -> str:
    limits = f"angle_min: {-np.pi}\nangle_increment: {2 * np.pi / 400}\nrange_min: 0.05\nrange_max: 20.0\n"
    path.write_text(f"{limits}ranges: [{', '.join(f'{r:.4f}' for r in ranges)}]\n")
    return str(path)


@pytest.mark.parametrize("method", ["ndt", "icp", "icp_plane"])
def test_laser_scans_are_aligned_in_the_plane(tmp_path: Path, rng: np.random.Generator, method: str) -> None:
    source = write_scan(tmp_path / "source.yaml", walls(0.2, 0.1, 0.1, rng))
    target = write_scan(tmp_path / "target.yaml", walls(0.0, 0.0, 0.0, rng))
    outcome = CliRunner().invoke(
        command, [source, target, "--method", method, "-o", str(tmp_path / "out")], catch_exceptions=False
    )
    result = json.loads(outcome.stdout)
    assert result["converged"], result["reason"]
    error = boxminus(np.array(result["T_target_source"]), np.eye(4)) - [0.2, 0.1, 0.0, 0.0, 0.0, 0.1]
    assert np.abs(error).max() < 0.02
    np.testing.assert_allclose(error[2:5], 0.0, atol=1e-9)
    assert (tmp_path / "out" / "registration.png").stat().st_size > 10_000


def test_flat_clouds_with_a_height_are_in_the_plane_too(tmp_path: Path, rng: np.random.Generator) -> None:
    files = []
    for name, place in (("source", (0.2, 0.1, 0.1)), ("target", (0.0, 0.0, 0.0))):
        ranges, angle = walls(*place, rng), np.linspace(-np.pi, np.pi, 400, endpoint=False)
        points = np.column_stack([ranges * np.cos(angle), ranges * np.sin(angle), np.full(400, 0.3)])
        files.append(str(write_pcd(tmp_path / f"{name}.pcd", points)))
    result = json.loads(CliRunner().invoke(command, files, catch_exceptions=False).stdout)
    assert np.abs(boxminus(np.array(result["T_target_source"]), np.eye(4))[[2, 3, 4]]).max() < 1e-9
    assert np.array(result["T_target_source"])[0, 3] == pytest.approx(0.2, abs=0.02)


def test_a_scan_is_not_aligned_to_a_cloud_in_space(
    clouds: tuple[str, str], tmp_path: Path, rng: np.random.Generator
) -> None:
    scan = write_scan(tmp_path / "scan.yaml", walls(0.0, 0.0, 0.0, rng))
    with pytest.raises(ValueError, match="plane and the other in space"):
        CliRunner().invoke(command, [scan, clouds[1]], catch_exceptions=False)
