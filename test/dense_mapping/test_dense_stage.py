# SPDX-License-Identifier: Apache-2.0
"""One dense stage: on final trajectories and while they move the same images make the same model and the same plan."""

from __future__ import annotations

import numpy as np
import pytest

from dense_mapping.dense_model import DenseConfig
from dense_mapping.dense_stage import _MAX_WAITING, DenseStage
from dense_room import Room
from slam_core.geometry import OPTICAL_FROM_RIG, boxplus, invert_transform, make_transform, so3_exp
from slam_core.messages.key_frames import AnchoredKeyFrame
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, Mask

T_BASE_CAMERA = make_transform(OPTICAL_FROM_RIG.T, np.array([0.1, 0.0, 0.0]))
T_MAP_WORLD = make_transform(so3_exp(np.array([0.06, -0.04, 0.0])), np.zeros(3))
"""The map's frame is that of a rig that started at an angle."""
AGENTS = ("one", "two")
STEP_NS = 100_000_000
IMU_GAP = range(3, 7)
"""Steps in which no accelerometer is heard."""


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


def path_of(room: Room, agent: str) -> Trajectory:
    """Half of the room's poses, of the rig and in the map's frame."""
    steps = half(agent)
    poses = np.array([T_MAP_WORLD @ room.poses[k] @ invert_transform(T_BASE_CAMERA) for k in steps])
    return Trajectory(np.array([(k + 1) * STEP_NS for k in steps]), poses)


def half(agent: str) -> range:
    return range(6) if agent == "one" else range(6, 12)


def feed(stage: DenseStage, room: Room, *, coloured: bool) -> None:
    """All images with their odometry, colours and accelerometer readings, in order."""
    rng = np.random.default_rng(5)
    for agent in AGENTS:
        path = path_of(room, agent)
        for k, stamp, T in zip(half(agent), path.stamps_ns.tolist(), path.poses, strict=True):
            stage.add_odometry(agent, invert_transform(path.poses[0]) @ T)
            image = room.depth(k, rng)
            if stage.wants(agent, "tof", stamp, T_BASE_CAMERA):
                object.__setattr__(image, "stamp_ns", stamp)
                stage.add(agent, "tof", T_BASE_CAMERA, image, None if not coloured else np.empty((0, 0, 3), np.uint8))
            if coloured:
                stage.add_colour(agent, "tof", stamp + 1_000_000, red(k))
            if k not in IMU_GAP:
                stage.add_force(agent, stamp, T[:3, :3].T @ T_MAP_WORLD[:3, :3] @ [0.0, 0.0, 9.81])


def red(k: int) -> ByteArray:
    return np.full((120, 160, 3), (200, 10, 20 * k), np.uint8)


@pytest.mark.parametrize("coloured", [False, True])
def test_moving_poses_end_in_the_model_of_final_ones(room: Room, coloured: bool) -> None:
    paths = {agent: path_of(room, agent) for agent in AGENTS}
    with DenseStage(DenseConfig(), paths, frozenset(AGENTS if coloured else ())) as final:
        feed(final, room, coloured=coloured)
        final.finish()
    moving = DenseStage(DenseConfig())
    feed(moving, room, coloured=coloured)
    assert moving.waiting == 12
    for agent, path in paths.items():
        moving.set_path(agent, path)
    assert moving.waiting == final.waiting == 0
    assert len(final.model.keyframes) == len(moving.model.keyframes) == 12
    np.testing.assert_array_equal(final.model.volume.voxels, moving.model.volume.voxels)
    np.testing.assert_array_equal(final.model.volume.colours, moving.model.volume.colours)
    np.testing.assert_array_equal(final.specific_force(), moving.specific_force())
    plans = [stage.floor_plans(stage.surface()) for stage in (moving, final)]
    for a, b in zip(*plans, strict=True):
        np.testing.assert_allclose(a.T_map_plan[:3, 2], T_MAP_WORLD[:3, 2], atol=0.01)
        np.testing.assert_allclose(a.T_map_plan, b.T_map_plan, atol=1e-9)


def test_what_was_put_in_at_a_wrong_pose_follows_and_so_does_gravity(room: Room) -> None:
    stage, paths = DenseStage(DenseConfig()), {agent: path_of(room, agent) for agent in AGENTS}
    feed(stage, room, coloured=False)
    for agent, path in paths.items():
        wrong = Trajectory(path.stamps_ns, boxplus(path.poses, np.tile([0.2, 0, 0, 0.1, 0, 0], (len(path), 1))))
        stage.set_path(agent, wrong)
    for agent, path in paths.items():
        stage.set_path(agent, path)
    right = DenseStage(DenseConfig(), paths)
    with right:
        feed(right, room, coloured=False)
        right.finish()
    np.testing.assert_array_equal(stage.specific_force(), right.specific_force())
    for a, b in zip(stage.model.keyframes, right.model.keyframes, strict=True):
        np.testing.assert_array_equal(a.T_map_camera, b.T_map_camera)


def test_without_an_accelerometer_nothing_is_said_of_gravity(room: Room) -> None:
    assert DenseStage(DenseConfig(), {"one": path_of(room, "one")}).specific_force() is None


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("final", [False, True])
def test_masked_pixels_are_not_in_the_model(room: Room, final: bool, late: bool) -> None:
    path = path_of(room, "one")
    stamp, image = int(path.stamps_ns[0]), room.depth(0, np.random.default_rng(5))
    object.__setattr__(image, "stamp_ns", stamp)
    pixels = np.zeros(image.depth.shape, np.uint8)
    pixels[:, : pixels.shape[1] // 2] = 1
    masks = frozenset({"one/tof"})
    with DenseStage(DenseConfig(), {"one": path} if final else None, with_masks=masks) as stage:
        stage.add_odometry("one", path.poses[0])
        assert stage.wants("one", "tof", stamp, T_BASE_CAMERA)
        steps = [
            lambda: stage.add_mask("one", "tof", Mask(stamp, pixels)),
            lambda: stage.add("one", "tof", T_BASE_CAMERA, image),
        ]
        for step in reversed(steps) if late else steps:
            step()
        stage.set_path("one", path)
        stage.finish()
    (placed,) = stage.model.keyframes
    depth = placed.keyframe.depth
    edge = (pixels.shape[1] // 2 + 8) * depth.shape[1] // pixels.shape[1]
    assert not depth[:, :edge].any()
    assert depth[:, edge + 1 :].any()
    assert stage.refused_masks == 0


def test_a_mask_of_another_size_is_refused(room: Room) -> None:
    stage, image = DenseStage(DenseConfig()), room.depth(0, np.random.default_rng(5))
    stage.add_mask("one", "tof", Mask(image.stamp_ns, np.ones((7, 9), np.uint8)))
    stage.add("one", "tof", T_BASE_CAMERA, image)
    assert (stage.refused_masks, stage.waiting) == (1, 1)


def test_a_key_frame_of_the_radio_is_where_its_submap_is_and_moves_with_it(room: Room) -> None:
    image = room.depth(3, np.random.default_rng(5))
    object.__setattr__(image, "stamp_ns", 12_345)  # the path has no pose of this time
    T_start_camera = boxplus(T_BASE_CAMERA, np.array([0.3, 0.1, 0.0, 0.0, 0.1, 0.0]))
    stage, path = DenseStage(DenseConfig()), path_of(room, "one")
    frame = AnchoredKeyFrame(image, red(1), 2 * STEP_NS, T_start_camera)
    assert not stage.add_anchored("one", frame)  # no path yet
    assert stage.set_path("one", path) == 1
    placed = stage.model.keyframes[0]
    np.testing.assert_allclose(placed.T_map_camera, path.poses[1] @ T_start_camera, atol=1e-12)
    assert (placed.keyframe.picture == red(1)[0, 0]).all()
    assert not stage.add_anchored("one", frame)  # it is there
    second = AnchoredKeyFrame(room.depth(4, np.random.default_rng(6)), red(1), 2 * STEP_NS, T_start_camera)
    assert stage.add_anchored("one", second)  # of the same submap
    moved = boxplus(path.poses, np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert stage.set_path("one", Trajectory(path.stamps_ns, moved)) == 2
    for placed in stage.model.keyframes:
        np.testing.assert_allclose(placed.T_map_camera, moved[1] @ T_start_camera, atol=1e-12)


def test_a_key_frame_of_the_radio_outlasts_a_new_session_and_may_come_again_once_dropped(room: Room) -> None:
    stage, path = DenseStage(DenseConfig()), path_of(room, "one")
    rng = np.random.default_rng(5)
    frame = AnchoredKeyFrame(room.depth(3, rng), red(1), 2 * STEP_NS, T_BASE_CAMERA)
    stage.add_anchored("one", frame)
    stage.add("two", "tof", T_BASE_CAMERA, room.depth(2, rng))
    stage.begin_session()  # of another agent
    assert (stage.waiting, stage.dropped) == (1, 1)
    image = room.depth(1, rng)
    for _ in range(_MAX_WAITING):
        stage.add("two", "tof", T_BASE_CAMERA, image)
    assert (stage.waiting, stage.dropped) == (_MAX_WAITING, 2)
    stage.set_path("one", path)
    assert not stage.model.keyframes
    assert stage.add_anchored("one", frame)  # asked for again
    assert not stage.add_anchored("one", frame)
    assert len(stage.model.keyframes) == 1
