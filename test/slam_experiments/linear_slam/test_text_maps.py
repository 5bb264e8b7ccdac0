# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from text_world import city, write

from slam_core.geometry import euler_from_rotation, rotation_from_euler
from slam_experiments.commands.join import command
from slam_experiments.linear_slam.text_joining import TextJoiningConfig, join_text_maps
from slam_experiments.linear_slam.text_maps import TextMap, find_maps, read_maps


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "optimum"), [("DLR_200_local_maps", 11163.643405947), ("8240_data_50_local_maps", 458.154366004)]
)
@pytest.mark.parametrize("solver", ["multifrontal", "cholmod", "superlu"])
def test_public_sets_reach_their_optimum_from_the_chained_start(
    data_dir: Path, name: str, optimum: float, solver: str
) -> None:
    maps, dimension = read_maps(find_maps(data_dir / "linear_slam_txt" / name))
    result = join_text_maps(maps, dimension, TextJoiningConfig(solver=solver))
    assert result.chi2 == pytest.approx(optimum, rel=1e-6)
    assert result.solver == solver


def walk(dimension: int, count: int, rng: np.random.Generator, noise: float) -> tuple[list[TextMap], np.ndarray]:
    """Maps along a closed loop with features seen from several poses; true positions of the poses."""
    angle = np.linspace(0, 2 * np.pi, count + 1)
    full = [rotation_from_euler(a, 0.2 * np.sin(a), 0.1) if dimension == 3 else rotation_from_euler(a) for a in angle]
    R = np.array(full)[:, :dimension, :dimension]
    t = np.stack([4 * np.sin(angle), 4 - 4 * np.cos(angle), np.sin(2 * angle)], axis=1)[:, :dimension]
    points = rng.uniform(-2, 10, (40, dimension)) - 2.0
    maps = []
    for k in range(count):
        near = np.sort(np.argsort(np.linalg.norm(points - t[k], axis=1))[:8])
        relative = R[k].T @ R[k + 1]
        angles = (
            euler_from_rotation(relative) if dimension == 3 else np.array([np.arctan2(relative[1, 0], relative[0, 0])])
        )
        values = np.concatenate([R[k].T @ (t[k + 1] - t[k]), angles, ((points[near] - t[k]) @ R[k]).ravel()])
        values = values + noise * rng.normal(size=len(values))
        size = dimension + len(angles)
        information = np.eye(len(values)) / 0.01**2
        maps.append(
            TextMap(
                -k,
                np.array([-k - 1]),
                values[:size].reshape(1, -1),
                near + 1,
                values[size:].reshape(-1, dimension),
                information,
            )
        )
    return maps, (t - t[0]) @ R[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_exact_maps_are_joined_exactly(dimension: int, rng: np.random.Generator, tmp_path: Path) -> None:
    maps, truth = walk(dimension, 12, rng, 0.0)
    write(maps, tmp_path)
    read, found = read_maps(find_maps(tmp_path))
    assert found == dimension
    result = join_text_maps(read, found)
    assert result.chi2 < 1e-9
    assert result.pose_ids.tolist() == [-k for k in range(13)]
    assert np.allclose(result.poses[:, :dimension], truth, atol=1e-7)


@pytest.mark.parametrize("dimension", [2, 3])
def test_noise_leaves_the_chi2_of_the_degrees_of_freedom(dimension: int, rng: np.random.Generator) -> None:
    maps, _ = walk(dimension, 30, rng, 0.01)
    result = join_text_maps(maps, dimension)
    rows = sum(m.poses.size + m.features.size for m in maps)
    dof = rows - (result.poses.size - maps[0].poses.size) - result.features.size
    assert abs(result.chi2 - dof) < 4.0 * np.sqrt(2.0 * dof)


def test_files_are_taken_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for k in (10, 9, 1, 100):
        (tmp_path / f"localmap_{k}.txt").write_text("")
    (tmp_path / "notes.txt").write_text("")
    assert [p.stem.split("_")[1] for p in find_maps(tmp_path)] == ["1", "9", "10", "100"]


def test_a_pose_graph_with_rising_ids_is_read(tmp_path: Path) -> None:
    """Two maps of three poses each that close a triangle; ids of poses are positive, there are no features."""
    corner = 2 * np.pi / 3
    one = [(1, 1.0, 0.0, corner), (2, 0.5, np.sqrt(0.75), 2 * corner)]
    two = [(2, 1.0, 0.0, corner), (0, 0.5, np.sqrt(0.75), 2 * corner)]
    for k, (reference, poses) in enumerate([(0, one), (1, two)]):
        rows = [str(reference), "6"] + [f"{p[0]} {v}" for p in poses for v in p[1:]]
        rows += [" ".join(map(str, row)) for row in 100 * np.eye(6)]
        (tmp_path / f"localmap_{k + 1}.txt").write_text("\n".join(rows))
    maps, dimension = read_maps(find_maps(tmp_path))
    result = join_text_maps(maps, dimension)
    assert dimension == 2
    assert len(result.features) == 0
    assert result.chi2 < 1e-12


def with_a_pose_twice(m: TextMap, dimension: int, apart: np.ndarray, full_turn: int = 0) -> TextMap:
    """The map with its pose written a second time, ``apart`` from the first, both known half as well."""
    size = m.poses.shape[1]
    copy = m.poses[0] + apart
    copy[-1] += 2 * np.pi * full_turn
    J = np.eye(len(m.information))
    J = np.concatenate([J[:size], J])
    share = np.full(len(J), 1.0)
    share[: 2 * size] = np.sqrt(0.5)
    information = (J * share[:, None]) @ m.information @ (J * share[:, None]).T
    information += 1e-3 * np.eye(len(J))
    ids = np.concatenate([m.pose_ids, m.pose_ids])
    return TextMap(m.reference, ids, np.stack([m.poses[0], copy]), m.feature_ids, m.features, information)


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_id_that_stands_twice_in_a_map_is_one_unknown(
    dimension: int, rng: np.random.Generator, tmp_path: Path
) -> None:
    maps, truth = walk(dimension, 12, rng, 0.0)
    odd = with_a_pose_twice(maps[5], dimension, np.zeros(maps[5].poses.shape[1]), full_turn=1)
    write([*maps[:5], odd, *maps[6:]], tmp_path)
    read, found = read_maps(find_maps(tmp_path))
    assert found == dimension, "six values in one map do not make a 2D set a 3D one"
    assert read[5].pose_ids.tolist() == maps[5].pose_ids.tolist()
    assert np.allclose(read[5].poses, maps[5].poses, atol=1e-9)
    result = join_text_maps(read, found)
    assert np.allclose(result.poses[:, :dimension], truth, atol=1e-6)


def test_two_copies_of_a_pose_are_weighed_by_their_information(rng: np.random.Generator, tmp_path: Path) -> None:
    rows = ["0", "6", *(f"-1 {v}" for v in (1.0, 0.0, 0.1, 2.0, 0.0, 0.1))]
    rows += [" ".join(map(str, row)) for row in np.diag([3.0, 1.0, 5.0, 1.0, 1.0, 5.0])]
    (tmp_path / "localmap_1.txt").write_text("\n".join(rows))
    other = ["1", "3", "-2 1", "-2 0", "-2 0", "1 0 0", "0 1 0", "0 0 1"]
    (tmp_path / "localmap_2.txt").write_text("\n".join(other))
    (first, _), dimension = read_maps(find_maps(tmp_path))
    assert dimension == 2
    assert np.allclose(first.poses, [[1.25, 0.0, 0.1]])
    assert np.allclose(first.information, np.diag([4.0, 2.0, 10.0]))


@pytest.mark.parametrize("dimension", [2, 3])
def test_covariances_are_those_of_the_errors(dimension: int, rng: np.random.Generator) -> None:
    """Over many walks the errors of the last pose and of a feature are as large as claimed."""
    nees = []
    for _ in range(30):
        maps, truth = walk(dimension, 8, rng, 0.01)
        result = join_text_maps(maps, dimension)
        error = result.poses[-1, :dimension] - truth[-1]
        nees.append(error @ np.linalg.solve(result.pose_covariances[-1][:dimension, :dimension], error))
        assert not result.pose_covariances[0].any()
        assert np.linalg.eigvalsh(result.feature_covariances).min() > 0.0
    assert 0.6 * dimension < np.mean(nees) < 1.6 * dimension


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("0\n3\n-1 a\n", "not a text submap"),
        ("0\n3\n-1 1\n-1 2\n-1 3\n1 0 0\n", "holds 11 numbers"),
        ("", "holds 0 numbers"),
        ("0\n3\n-1 1\n-1 2\n-1 3\n1 0 0 0 1 0 0 0 -1\n", "not positive definite"),
        ("0\n3\n-1 1\n-1 nan\n-1 3\n1 0 0 0 1 0 0 0 1\n", "not finite"),
        ("0\n1\n-1 1\n1\n", "an id has 1 values"),
        ("0\n3\n-1 1\n-1 2\n-1 3\n1 9 0 0 1 0 0 0 1\n", "not symmetric"),
        ("0\n3\n-1.5 1\n-1.5 2\n-1.5 3\n1 0 0 0 1 0 0 0 1\n", "id -1.5 is not a whole number"),
        ("0\n3\n-1 1\n5 2\n-1 3\n1 0 0 0 1 0 0 0 1\n", "an id has 1 values"),
    ],
)
def test_other_files_are_refused_by_name(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "localmap_1.txt").write_text(text)
    with pytest.raises(ValueError, match=why) as error:
        read_maps(find_maps(tmp_path))
    assert "localmap_1.txt" in str(error.value)


def test_a_planar_map_among_spatial_ones_is_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    spatial, _ = walk(3, 3, rng, 0.01)
    write(spatial, tmp_path)
    (tmp_path / "localmap_2.txt").write_text("1\n3\n-2 1\n-2 2\n-2 3\n1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(ValueError, match=r"localmap_2.txt: feature id -2 .* 2D map among 3D"):
        read_maps(find_maps(tmp_path))


def test_a_missing_file_is_said_so(rng: np.random.Generator, tmp_path: Path) -> None:
    maps, _ = walk(2, 6, rng, 0.01)
    write(maps, tmp_path)
    (tmp_path / "localmap_3.txt").unlink()
    with pytest.raises(ValueError, match=r"3 submaps share no pose .* file missing"):
        join_text_maps(*read_maps(find_maps(tmp_path)))


def test_a_start_that_has_collapsed_still_leads_to_the_optimum() -> None:
    maps = city(1500, seed=2, noise=3.0, extent=12)
    freedom = sum(m.poses.size for m in maps) - 3 * 1500
    result = join_text_maps(maps, 2)
    assert abs(result.chi2 - freedom) < 5.0 * np.sqrt(2.0 * freedom)
    assert result.start.startswith("incremental")  # batch from the chained start ends elsewhere


def test_maps_that_do_not_hang_together_are_refused(rng: np.random.Generator) -> None:
    maps, _ = walk(2, 6, rng, 0.0)
    with pytest.raises(ValueError, match="share no pose"):
        join_text_maps([maps[0], maps[3]], 2)


@pytest.mark.parametrize("options", [(), ("--rows", "block"), ("--robust", "cauchy")])
def test_the_command_writes_summary_poses_and_features(
    options: tuple[str, ...], rng: np.random.Generator, tmp_path: Path
) -> None:
    maps, _ = walk(2, 8, rng, 0.01)
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    write(maps, source)
    result = CliRunner().invoke(command, [str(source), "-o", str(out), *options], catch_exceptions=False)
    assert result.exit_code == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["submaps"] == 8
    assert summary["rows"] == ("block" if "block" in options else "joint")
    assert summary["features"] == len((out / "features.txt").read_text().splitlines())
    assert len((out / "poses.txt").read_text().splitlines()) == 9
    assert summary["chi2"] > 0.0
    assert summary["degrees_of_freedom"] == sum(len(m.information) for m in maps) - 8 * 3 - 2 * summary["features"]
    assert summary["wall_s"] > 0.0
    assert sorted(p.name for p in out.iterdir()) == [
        ".slam.json", "features.txt", "features_covariance.txt", "map.png", "poses.txt", "poses_covariance.txt",
        "summary.json",
    ]  # fmt: skip
    rows = np.loadtxt(out / "poses_covariance.txt")
    assert rows.shape == (9, 1 + 3 * 3)
    assert np.linalg.eigvalsh(rows[-1, 1:].reshape(3, 3)).min() > 0.0


def test_files_of_other_editors_are_read(tmp_path: Path) -> None:
    write(city(30), tmp_path)
    first = tmp_path / "localmap_1.txt"
    first.write_bytes(b"\xef\xbb\xbf" + first.read_bytes().replace(b"\n", b"\r\n") + b"\r\n")
    maps, dimension = read_maps(find_maps(tmp_path))
    assert len(maps) == 30
    assert dimension == 2


def test_what_did_not_converge_is_said(tmp_path: Path) -> None:
    write(city(60), tmp_path / "maps")
    config = tmp_path / "config.yaml"
    config.write_text("optimizer: {max_iterations: 1, relative_tolerance: 0.0}\n")
    arguments = [str(tmp_path / "maps"), "-o", str(tmp_path / "out"), "--config", str(config)]
    result = CliRunner().invoke(command, arguments)
    assert result.exit_code == 0
    assert "not converged after 1 iterations" in result.output
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["converged"] is False
