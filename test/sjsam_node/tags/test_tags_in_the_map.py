# SPDX-License-Identifier: Apache-2.0
"""Tags in the joined map, by submaps that have nothing but tags in common."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.links import Status
from sjsam_node.tags.known_tags import KnownTagsConfig, read_known_tags
from sjsam_node.tags.map_tags import map_tags, moved_tags, tags_file, tags_text
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    invert_transform,
    make_transform,
    quaternion_from_rotation,
    rotation_from_euler,
    transform_points,
)
from slam_core.tags import corner_ids, square
from slam_core.types import PoseEstimate, Submap

SIZE = 0.2
WALL = rotation_from_euler(np.pi / 2, 0.0, np.pi / 2)
TAGS = {n: make_transform(WALL, np.array([3.0 * n, 2.0, 1.4])) for n in range(6)}
"""T_world_tag; the numbers follow the wall."""
STEP = 3.0


def pose(x: float, yaw: float = 0.0) -> FloatArray:
    return make_transform(rotation_from_euler(yaw), np.array([x, 0.0, 1.2]))


def submap(
    rng: np.random.Generator, agent: str, index: int, start: FloatArray, end: FloatArray, tags: dict[int, FloatArray],
    *, follows: bool = True,
) -> Submap:  # fmt: skip
    """From one pose to another, with landmarks of its own and the tags (T_world_tag), drawn from what it claims."""
    own = rng.uniform([-1.0, -2.0, -1.0], [4.0, 2.0, 1.0], (30, 3))
    T = invert_transform(start)
    corners = [transform_points(T @ T_tag, square(SIZE)) for T_tag in tags.values()]
    points = np.concatenate([own, *corners])
    n = len(points)
    sigma = np.concatenate([[0.01] * 3, [0.003] * 3, np.full(3 * n, 0.006)])
    error = sigma * rng.normal(size=len(sigma))
    end_pose = boxplus(T @ end, error[:6])
    descriptors = rng.normal(size=(n, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    descriptors[30:] = 0.0
    stamp = int(1e9 * (1000 + 10 * index + (500 if agent == "two" else 0)))
    covariance = np.diag(sigma**2)
    path = (
        PoseEstimate(stamp, np.eye(4), 1e-12 * np.eye(6)),
        PoseEstimate(stamp + 9_000_000_000, end_pose, covariance[:6, :6]),
    )
    ids = np.concatenate([np.arange(30) + 1000 * index, corner_ids(list(tags))]).astype(np.int64)
    return Submap(
        agent, index, stamp, stamp + 9_000_000_000, end_pose, points + error[6:].reshape(-1, 3), covariance, ids,
        np.full(n, 5, np.int32), descriptors.astype(np.float32), path, follows_previous=follows and index > 0,
    )  # fmt: skip


def walk(
    rng: np.random.Generator, agent: str, sections: list[int], tags: dict[int, FloatArray], yaw: float = 0.0
) -> list[Submap]:
    """A submap of each section of the wall, one after the other, that sees the section's tag."""
    T_world = [pose(STEP * k, yaw) for k in [*sections, sections[-1] + 1]]
    return [
        submap(rng, agent, i, T_world[i], T_world[i + 1], {k: tags[k]} if k in tags else {})
        for i, k in enumerate(sections)
    ]


def joined(*walks: list[Submap], config: GlobalMapConfig | None = None) -> GlobalMap:
    global_map = GlobalMap(config)
    for one in walks:
        for s in one:
            assert global_map.add(s).accepted
    global_map.settle()
    return global_map


def test_agents_that_saw_one_tag_are_in_one_map_at_once(rng: np.random.Generator) -> None:
    one, two = walk(rng, "one", [0, 1, 2], TAGS), walk(rng, "two", [2, 3, 4], TAGS, yaw=0.7)
    global_map = GlobalMap()
    for s in one:
        global_map.add(s)
    report = global_map.add(two[0])
    assert report.closures == (("one", 2),)
    assert report.components == 1
    path = global_map.trajectory("two")
    found, true = path[0], invert_transform(pose(0.0)) @ pose(2 * STEP, 0.7)
    error = boxminus(found.T, true)
    assert np.linalg.norm(error[:3]) < 0.25
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # 99.9 % of 6 degrees of freedom


def test_agents_without_a_common_tag_stay_apart(rng: np.random.Generator) -> None:
    global_map = joined(walk(rng, "one", [0, 1], TAGS), walk(rng, "two", [3, 4], TAGS))
    assert global_map.components == 2


def test_poses_by_several_tags_are_as_uncertain_as_they_are_wrong() -> None:
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        global_map = joined(walk(rng, "one", [0, 1, 2, 3], TAGS), walk(rng, "two", [1, 2, 3], TAGS, yaw=-0.4))
        last = global_map.trajectory("two")[-1]
        error = boxminus(last.T, invert_transform(pose(0.0)) @ pose(4 * STEP, -0.4))
        squares.append(error @ np.linalg.solve(last.covariance, error))
    assert 3.0 < np.mean(squares) < 11.0  # 6 of 12 draws: 6 +- 3 sigma is 3.0 ... 9.0, and linearisation


def test_a_tag_that_was_moved_is_let_go_and_said(rng: np.random.Generator) -> None:
    moved = TAGS | {2: make_transform(WALL, np.array([8.0, 2.0, 0.4]))}
    before, after = walk(rng, "one", [0, 1, 2, 3], TAGS), walk(rng, "two", [0, 1, 2, 3], moved)
    global_map = joined(before, after)
    assert global_map.components == 1
    last = global_map.trajectory("two")[-1]
    assert np.linalg.norm(last.T[:3, 3] - [4 * STEP, 0.0, 0.0]) < 0.25
    tags = map_tags(global_map.snapshot(), global_map.landmarks())
    assert moved_tags(tags) == [2]
    assert "in more than one place: 2" in tags_text(tags)


def test_the_map_disagrees_with_a_closure_by_a_moved_tag(rng: np.random.Generator) -> None:
    moved = TAGS | {2: make_transform(WALL, np.array([8.0, 2.0, 0.4]))}
    global_map = joined(walk(rng, "one", [0, 1, 2, 3], TAGS), walk(rng, "two", [0, 1, 2, 3], moved))
    seen_elsewhere = global_map.agents.record("two", 0, 2)
    assert seen_elsewhere is not None
    links = global_map.tags.closures([], seen_elsewhere)
    assert [(k.first, k.status) for k in links] == [(2, Status.INCONSISTENT)]


def test_what_was_joined_by_a_moved_tag_is_let_go_when_others_say_so(rng: np.random.Generator) -> None:
    moved = TAGS | {0: make_transform(WALL, np.array([1.0, 2.0, 0.6]))}
    before, after = walk(rng, "one", [0, 1, 2, 3, 4], TAGS), walk(rng, "two", [0, 1, 2, 3, 4], moved)
    global_map = joined(before, after)
    last = global_map.trajectory("two")[-1]
    assert np.linalg.norm(last.T[:3, 3] - [5 * STEP, 0.0, 0.0]) < 0.25
    assert moved_tags(map_tags(global_map.snapshot(), global_map.landmarks())) == [0]


def test_a_loop_is_closed_by_its_tag(rng: np.random.Generator) -> None:
    there = walk(rng, "", [0, 1, 2, 3], TAGS)
    again = submap(rng, "", 4, pose(4 * STEP), pose(0.0), {})
    back = submap(rng, "", 5, pose(0.0), pose(STEP), {0: TAGS[0]})
    global_map = GlobalMap()
    for s in (*there, again):
        global_map.add(s)
    before = global_map.snapshot().end(4).covariance
    assert global_map.add(back).closures == (("", 0),)
    after = global_map.snapshot().start(5).covariance
    assert np.trace(after[:3, :3]) < 0.5 * np.trace(before[:3, :3])


def known_file(folder: Path, tags: dict[int, FloatArray]) -> Path:
    rows = [
        f"  - {{id: {n}, position: {T[:3, 3].tolist()}, quaternion: {quaternion_from_rotation(T[:3, :3]).tolist()}}}"
        for n, T in tags.items()
    ]
    path = folder / "known.yaml"
    path.write_text("size: 0.2\nsigma: 0.005\nsigma_angle: 0.005\ntags:\n" + "\n".join(rows) + "\n")
    return path


def with_known(path: Path) -> GlobalMapConfig:
    return replace(GlobalMapConfig(), tags=KnownTagsConfig(known=str(path)))


def test_known_tags_bring_the_map_into_the_frame_of_the_building(rng: np.random.Generator, tmp_path: Path) -> None:
    T_building_world = make_transform(rotation_from_euler(1.1), np.array([40.0, -7.0, 3.0]))
    known = known_file(tmp_path, {n: T_building_world @ TAGS[n] for n in (1, 3)})
    global_map = joined(walk(rng, "", [0, 1, 2, 3], TAGS), config=with_known(known))
    for estimate, true in zip(
        (global_map.trajectory("")[0], global_map.trajectory("")[-1]), (pose(0.0), pose(4 * STEP)), strict=True
    ):
        error = boxminus(estimate.T, T_building_world @ true)
        assert np.linalg.norm(error[:3]) < 0.15
        assert error @ np.linalg.solve(estimate.covariance, error) < 22.5
    assert "2 where the file has them" in tags_text(map_tags(global_map.snapshot(), global_map.landmarks()))
    global_map.save(tmp_path / "map")
    loaded = GlobalMap.load(tmp_path / "map")
    np.testing.assert_array_equal(loaded.trajectory("")[-1].T, global_map.trajectory("")[-1].T)


def test_a_known_tag_that_hangs_elsewhere_is_found(rng: np.random.Generator, tmp_path: Path) -> None:
    wrong = make_transform(WALL, TAGS[2][:3, 3] + [0.0, 0.0, 1.5])
    known = known_file(tmp_path, {n: wrong if n == 2 else TAGS[n] for n in (0, 1, 2, 3)})
    global_map = joined(walk(rng, "one", [0, 1, 2, 3], TAGS), config=with_known(known))
    assert moved_tags(map_tags(global_map.snapshot(), global_map.landmarks())) == [2]
    last = global_map.trajectory("one")[-1]
    assert np.linalg.norm(last.T[:3, 3] - pose(4 * STEP)[:3, 3]) < 0.15


def test_the_tags_of_a_run_are_a_file_of_known_tags(rng: np.random.Generator, tmp_path: Path) -> None:
    import yaml

    global_map = joined(walk(rng, "one", [0, 1, 2], TAGS))
    path = tmp_path / "tags.yaml"
    path.write_text(yaml.safe_dump(tags_file(map_tags(global_map.snapshot(), global_map.landmarks()))))
    tags = read_known_tags(path)
    assert [t.number for t in tags] == [0, 1, 2]
    for tag in tags:
        true = invert_transform(pose(0.0)) @ TAGS[tag.number]
        assert np.linalg.norm(tag.T[:3, 3] - true[:3, 3]) < 5 * tag.sigma


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tags: 3", "list 'tags'"),
        ("tags: [{id: 1}]", "lacks 'position'"),
        ("tags: [{id: -1, position: [0,0,0], quaternion: [0,0,0,1]}]", "whole number"),
        ("tags: [{id: 1, position: [0,.nan,0], quaternion: [0,0,0,1]}]", "finite"),
        ("tags: [{id: 1, position: [0,0,0], quaternion: [0,0,0,2]}]", "norm"),
        ("tags: [{id: 1, position: [0,0,0], quaternion: [0,0,0,1], sigma: 0}]", "sigma must be positive"),
        ("tags: [{id: 1, position: [0,0,0], quaternion: [0,0,0,1], colour: red}]", "colour"),
        ("tags: [{id: 1, position: [0,0,0], quaternion: [0,0,0,1]}, {id: 1, position: [1,0,0], quaternion: [0,0,0,1]}]",
         "twice"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_with_its_name(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "known.yaml"
    path.write_text("size: 0.2\n" + text)
    with pytest.raises(ValueError, match=said) as error:
        read_known_tags(path)
    assert str(path) in str(error.value)


def test_no_agent_is_called_like_the_building(rng: np.random.Generator) -> None:
    report = GlobalMap().add(walk(rng, "building", [0, 1], TAGS)[0])
    assert not report.accepted
    assert "building" in report.reason
