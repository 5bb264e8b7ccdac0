# SPDX-License-Identifier: Apache-2.0
"""The dense model of a simulated room against its true walls: a wrong scale or mounting must show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dense_mapping.dense_model import DenseConfig, DenseModel
from dense_room import Room
from slam_core.geometry import boxplus


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


def model_of(room: Room, rng: np.random.Generator, *, scale: float = 1.0, mounting: np.ndarray | None = None):
    model = DenseModel(replace(DenseConfig()))
    for k, T in enumerate(room.poses):
        seen_at = T if mounting is None else boxplus(T, mounting)
        assert model.wants("tof", seen_at)
        model.add("tof", seen_at, room.depth(k, rng, scale))
    return model


def test_the_surface_lies_on_the_walls_within_what_it_claims(room, rng):
    surface = model_of(room, rng).surface()
    errors = room.errors(surface)
    assert len(surface) > 10_000
    assert np.median(errors) < 0.005
    assert np.percentile(errors, 95) < 0.03
    assert 0.05 < np.mean(np.square(errors / surface.sigma)) < 1.5


def test_depth_one_fiftieth_too_long_shows(room, rng):
    """The errors that the test above tolerates are far below those of a scale that is wrong by 2 %."""
    errors = room.errors(model_of(room, rng, scale=1.02).surface())
    assert np.median(errors) > 0.02


@pytest.mark.parametrize("mounting", [[0.04, 0, 0, 0, 0, 0], [0, 0, 0.04, 0, 0, 0], [0, 0, 0, 0.03, 0.03, 0]])
def test_a_camera_mounted_elsewhere_shows(room, rng, mounting):
    errors = room.errors(model_of(room, rng, mounting=np.array(mounting)).surface())
    assert np.percentile(errors, 90) > 0.03


def test_normals_point_into_the_room(room, rng):
    surface = model_of(room, rng).surface()
    towards_middle = ([2.0, 1.5, 1.3] - surface.points) * surface.normals
    assert np.mean(towards_middle.sum(axis=1) > 0) > 0.9


def test_moving_key_frames_to_their_true_poses_is_as_good_as_having_put_them_there(room, rng):
    drift = [boxplus(T, np.array([0.02 * k, 0, 0, 0, 0, 0.005 * k])) for k, T in enumerate(room.poses)]
    images = [room.depth(k, rng) for k in range(len(room.poses))]
    moved, fresh = DenseModel(), DenseModel()
    for T_wrong, T, image in zip(drift, room.poses, images, strict=True):
        moved.add("tof", T_wrong, image)
        fresh.add("tof", T, image)
    before = np.percentile(room.errors(moved.surface()), 90)
    assert moved.move(lambda camera, k: room.poses[k], most=3) == 3
    while moved.move(lambda camera, k: room.poses[k]):
        pass
    after = room.errors(moved.surface())
    assert before > 0.05
    assert np.percentile(after, 90) < 0.02
    assert abs(len(after) - len(fresh.surface())) < 0.02 * len(after)
    assert moved.moved == 11, "the first key frame was where it belongs"


def test_the_same_images_give_the_same_bytes(room):
    one, two = (model_of(room, np.random.default_rng(5)).surface() for _ in range(2))
    assert one.points.tobytes() == two.points.tobytes()
    assert one.sigma.tobytes() == two.sigma.tobytes()
    assert one.faces.tobytes() == two.faces.tobytes()


def test_a_full_grid_takes_no_more_and_says_so(room, rng):
    model = DenseModel(replace(DenseConfig(), tsdf=replace(DenseConfig().tsdf, max_blocks=50)))
    model.add("tof", room.poses[0], room.depth(0, rng))
    assert len(model.volume) == 50
    assert model.volume.refused_blocks > 0


def test_one_camera_after_another_at_the_same_place_is_no_new_key_frame(room):
    model = DenseModel()
    assert model.wants("tof", room.poses[0])
    assert not model.wants("tof", boxplus(room.poses[0], np.full(6, 0.01)))
    assert model.wants("stereo", room.poses[0])


def test_nothing_seen_is_an_empty_surface():
    surface = DenseModel().surface()
    assert len(surface) == 0
    assert surface.faces.shape == (0, 3)
