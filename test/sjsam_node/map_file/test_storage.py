# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap
from sjsam_node.map_file import storage
from sjsam_node.map_file.map_validation import arrays_of
from sjsam_node.session.localization import Localizer
from slam_core.geometry import boxminus, boxplus, invert_transform
from slam_core.types import PoseEstimate, Submap


@pytest.fixture
def agent(rng: np.random.Generator) -> Agent:
    return Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.3), rng, "a")


def test_a_map_comes_back_to_the_last_bit(agent: Agent, tmp_path: Path) -> None:
    joined, _ = join(agent.submaps())
    joined.settle()
    said = joined.trajectory("a")
    joined.save(tmp_path / "map")
    loaded = GlobalMap.load(tmp_path / "map")
    assert np.array_equal(loaded.state.poses, joined.state.poses)
    assert np.array_equal(loaded.state.points, joined.state.points)
    assert np.array_equal(loaded.estimate.graph.landmark_of, joined.estimate.graph.landmark_of)
    for p, q in zip(loaded.trajectory("a"), said, strict=True):
        assert p.stamp_ns == q.stamp_ns
        assert np.array_equal(p.T, q.T)
        assert np.array_equal(p.covariance, q.covariance)


@pytest.mark.parametrize("stop", [3, 14, 20])
def test_saved_killed_loaded_and_continued_gives_the_same_map(stop: int, agent: Agent, tmp_path: Path) -> None:
    submaps = agent.submaps()
    whole, _ = join(submaps[:stop])
    whole.marks.add(whole.state.poses, np.array([1.0, 2.0, 0.5]), "a find")
    whole.save(tmp_path / "map")
    continued, reports = join(submaps[stop:], GlobalMap.load(tmp_path / "map"))
    _, expected = join(submaps[stop:], whole)
    assert [r.closures for r in reports] == [r.closures for r in expected]
    assert np.array_equal(continued.estimate.graph.landmark_of, whole.estimate.graph.landmark_of)
    assert np.abs(continued.state.points - whole.state.points).max() < 1e-9
    for p, q in zip(continued.trajectory("a"), whole.trajectory("a"), strict=True):
        assert np.abs(boxminus(p.T, q.T)).max() < 1e-9
        assert np.allclose(p.covariance, q.covariance, rtol=1e-6, atol=1e-12)
    assert np.allclose(
        continued.marks.positions(continued.state.poses), whole.marks.positions(whole.state.poses), atol=1e-9
    )
    assert [m.name for m in continued.marks.marks] == ["a find"]


def test_saving_in_between_does_not_matter(agent: Agent, tmp_path: Path) -> None:
    submaps = agent.submaps()
    plain, _ = join(submaps)
    saving, _ = join(submaps[:14])
    saving.save(tmp_path / "map")
    join(submaps[14:], saving)
    assert len(saving.landmarks().ids) == len(plain.landmarks().ids)
    for p, q in zip(saving.trajectory("a"), plain.trajectory("a"), strict=True):
        assert np.abs(boxminus(p.T, q.T)).max() < 1e-6


def test_saving_replaces_and_leaves_nothing_else(agent: Agent, tmp_path: Path) -> None:
    joined, _ = join(agent.submaps()[:3])
    joined.save(tmp_path / "map")
    joined.save(tmp_path / "map")
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
    files = sorted(p.name for p in (tmp_path / "map").iterdir())
    assert len(files) == 2
    assert files[0].startswith("arrays-")
    assert files[1] == "manifest.json"


def test_a_users_file_in_a_map_folder_stays(agent: Agent, tmp_path: Path) -> None:
    joined, _ = join(agent.submaps()[:3])
    joined.save(tmp_path / "map")
    own = tmp_path / "map" / "arrays_backup.npz"
    own.write_bytes(b"mine")
    with pytest.raises(ValueError, match="map"):
        joined.save(tmp_path / "map")
    assert own.read_bytes() == b"mine"
    GlobalMap.load(tmp_path / "map")


def test_foreign_newer_and_damaged_folders_are_refused(agent: Agent, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    with pytest.raises(ValueError, match="not a map"):
        GlobalMap.load(folder)
    joined, _ = join(agent.submaps()[:3])
    joined.save(folder)
    manifest, arrays = folder / "manifest.json", next(folder.glob("arrays-*.npz"))
    good, data = manifest.read_text(), arrays.read_bytes()
    for text, why in (
        ("{", "not JSON"),
        ("[]", "not a map of this program"),
        (json.dumps({"format": "other"}), "not a map of this program"),
        (json.dumps({**json.loads(good), "version": 99}), "version 99"),
        (json.dumps({**json.loads(good), "sha256": "0"}), "damaged"),
    ):
        manifest.write_text(text)
        with pytest.raises(ValueError, match=why):
            GlobalMap.load(folder)
    manifest.write_text(good)
    arrays.write_bytes(data[:-100])
    with pytest.raises(ValueError, match="damaged"):
        GlobalMap.load(folder)
    arrays.unlink()
    with pytest.raises(ValueError, match="arrays cannot be read"):
        GlobalMap.load(folder)


DAMAGES: dict[str, Callable[[dict[str, Any], dict[str, Any]], object]] = {
    "a pose that is not finite": lambda m, a: a["poses"].__setitem__((1, 0, 3), np.nan),
    "a pose that is not rigid": lambda m, a: a["poses"].__setitem__((1, 0, 0), 2.0),
    "too few poses": lambda m, a: a.update(poses=a["poses"][:-1]),
    "too few points": lambda m, a: a.update(points=a["points"][:-1]),
    "too many points": lambda m, a: a.update(points=np.vstack([a["points"], [[0.0, 0.0, 0.0]]])),
    "a component that is not there": lambda m, a: a["component_of"].__setitem__(0, 99),
    "a missing array": lambda m, a: a.pop("submap_1/descriptors"),
    "text instead of numbers": lambda m, a: a.update(poses=np.array(["x"])),
    "a covariance that is not positive": lambda m, a: a["submap_1/covariance"].__setitem__((0, 0), -1.0),
    "a link to nothing": lambda m, a: a["links/ends"].__setitem__((0, 1), 77),
    "a pair of no landmark": lambda m, a: a["links/pairs"].__setitem__((0, 0), 9999),
    "fewer pairs than named": lambda m, a: a.update({"links/pairs": a["links/pairs"][:-1]}),
    "a mark at no node": lambda m, a: m["marks"].append(["find", 99, 0.0, 0.0, 0.0]),
    "a mark of two numbers": lambda m, a: m["marks"].append(["find", 0, 0.0, 0.0]),
    "a mark at NaN": lambda m, a: m["marks"].append(["find", 0, 0.0, 0.0, float("nan")]),
    "a mark at a text": lambda m, a: m["marks"].append(["find", "0", 0.0, 0.0, 0.0]),
    "a record too few": lambda m, a: m["records"].pop(),
    "a record twice": lambda m, a: m["records"].__setitem__(2, m["records"][1]),
    "a record that starts nowhere": lambda m, a: m["records"][1].__setitem__(3, 50),
    "a record of words": lambda m, a: m["records"].__setitem__(0, "words"),
    "no records": lambda m, a: m.pop("records"),
    "arrays elsewhere": lambda m, a: m.update(arrays="../../etc/passwd"),
    "arrays that are a number": lambda m, a: m.update(arrays=7),
    "too few ties": lambda m, a: a.update(ties=a["ties"][:-1]),
    "a submap of another size": lambda m, a: a.update({"submap_0/landmarks": a["submap_0/landmarks"][:-1]}),
    "a path of another length": lambda m, a: a.update({"submap_0/path_stamps": a["submap_0/path_stamps"][:-1]}),
}


@pytest.fixture
def small_map(rng: np.random.Generator, tmp_path: Path) -> Path:
    joined, _ = join(Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.3), rng, "a").submaps()[:3])
    joined.save(tmp_path / "map")
    return tmp_path / "map"


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_map_that_cannot_be_true_is_refused_though_its_digests_are_right(damage: str, small_map: Path) -> None:
    stored = storage.pack(GlobalMap.load(small_map).stored())
    manifest, arrays = stored.manifest, {name: value.copy() for name, value in stored.arrays.items()}
    DAMAGES[damage](manifest, arrays)
    storage.write_packed(small_map, storage.PackedMap(manifest, arrays))
    if ("arrays" in damage and "elsewhere" in damage) or damage == "arrays that are a number":
        text = json.loads((small_map / "manifest.json").read_text())
        DAMAGES[damage](text, arrays)
        text["manifest_sha256"] = storage._digest(text)
        (small_map / "manifest.json").write_text(json.dumps(text))
    with pytest.raises(ValueError, match="damaged"):
        GlobalMap.load(small_map)


def test_arrays_that_claim_more_than_they_are_or_are_compressed_are_refused() -> None:
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    for kind, member, why in (
        (zipfile.ZIP_STORED, huge.getvalue(), "claims"),
        (zipfile.ZIP_DEFLATED, bytes(10**6), "compressed"),
    ):
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w", kind) as archive:
            archive.writestr("poses.npy", member)
        with pytest.raises(ValueError, match=why):
            arrays_of(data.getvalue())
    for data_bytes in (b"", b"PK", bytes(100)):
        with pytest.raises(ValueError, match="npz"):
            arrays_of(data_bytes)


def visitor(agent: Agent, rng: np.random.Generator) -> tuple[Agent, list[Submap]]:
    again = Agent(agent.world, agent.path[10:60], rng, "visitor", stamp_ns=10**12)
    return again, again.submaps()


def test_a_visitor_is_located_by_looks_and_the_map_does_not_change(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    before = joined.state.poses.copy()
    again, submaps = visitor(agent, rng)
    localizer = Localizer(joined)
    results = [localizer.process(submap) for submap in submaps]
    T = invert_transform(agent.path[0])
    assert sum(r.matched > 0 for r in results) >= len(results) // 2
    for k, result in enumerate(results):
        if result.pose is not None:
            assert np.linalg.norm((T @ again.true_start(k + 1) - result.pose.T)[:3, 3]) < 0.5
    assert results[-1].pose is not None
    assert np.array_equal(joined.state.poses, before)
    assert len(joined.estimate.graph.records) == len(agent.seen)


def test_an_initial_pose_is_enough_to_start(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    again, submaps = visitor(agent, rng)
    T = invert_transform(agent.path[0]) @ again.path[0]
    localizer = Localizer(joined)
    localizer.set_pose(
        PoseEstimate(0, boxplus(T, np.array([0.1, -0.1, 0.05, 0.0, 0.0, 0.03])), np.diag([0.04] * 3 + [0.01] * 3))
    )
    result = localizer.process(submaps[0])
    assert result.matched > 0
    assert result.pose is not None
    truth = invert_transform(agent.path[0]) @ again.true_start(1)
    assert np.linalg.norm((truth - result.pose.T)[:3, 3]) < 0.15


def test_a_stranger_is_not_located(agent: Agent, rng: np.random.Generator) -> None:
    joined, _ = join(agent.submaps())
    elsewhere = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "visitor")
    localizer = Localizer(joined)
    assert all(localizer.process(s).pose is None for s in elsewhere.submaps())


def test_a_full_disk_leaves_the_old_map_and_nothing_beside_it(
    small_map: Path, tmp_path: Path, full_disk: Callable[[], AbstractContextManager[None]]
) -> None:
    joined = GlobalMap.load(small_map)
    before = sorted(p.name for p in small_map.iterdir())
    joined.marks.add(joined.state.poses, np.zeros(3))
    for folder in (small_map, tmp_path / "new"):
        with full_disk(), pytest.raises(OSError, match=str(folder)):
            joined.save(folder)
    assert sorted(p.name for p in small_map.iterdir()) == before
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
    assert GlobalMap.load(small_map).marks.marks == []
