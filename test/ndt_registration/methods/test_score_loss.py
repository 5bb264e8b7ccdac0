# SPDX-License-Identifier: Apache-2.0
"""What a scan loses when its pose is moved: much across a wall, nothing along it, although its view ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ndt_registration.clouds.cloud import prepare
from ndt_registration.methods.score_loss import ScoreLoss, point_fits
from ndt_registration.registration import RegistrationConfig, Target
from slam_core.geometry import FloatArray, make_transform, rotation_from_euler, transform_points

STEP = 0.1


def losses(scan: FloatArray, target: FloatArray, T: FloatArray) -> FloatArray:
    """The lesser of the losses (3,) by a step forth and back along each axis."""
    config = RegistrationConfig()
    map_ = Target.build(target, config)
    cloud = prepare(scan, 2000, planar=False, centre=np.zeros(3))
    score_loss = ScoreLoss(map_.pyramid.layers(cloud, 0, 2000, config.rim_share), T)
    return np.array([min(score_loss.loss(s * STEP * np.eye(6)[k]) for s in (1.0, -1.0)) for k in range(3)])


def test_a_blank_wall_holds_across_only(empty_room: Any, at: Callable[..., FloatArray]) -> None:
    rng, wall, start, truth = np.random.default_rng(4), empty_room(60.0, 60.0, 60.0), at(57.0, 30.0, 30.0), at(0.0, 0.1)
    lost = losses(wall.scan(start @ truth, rng), wall.scan(start, rng), truth)
    assert lost[0] > 0.9
    assert (lost[1:] < 0.01).all()


def test_a_furnished_room_holds_everywhere(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng, truth = np.random.default_rng(4), at(0.0, 0.1)
    lost = losses(room.scan(start @ truth, rng), room.scan(start, rng), truth)
    assert (lost > 4.0 * RegistrationConfig().uncertainty.least_loss).all()


def test_points_fit_where_their_pose_brings_them(room: Any, start: FloatArray) -> None:
    rng, config = np.random.default_rng(4), RegistrationConfig()
    scan = room.scan(start, rng)
    T = make_transform(rotation_from_euler(0.03, -0.02, 0.04), np.array([0.02, -0.03, 0.01]))
    cloud = prepare(scan, 2000, planar=False, centre=np.zeros(3))
    layer = Target.build(scan, config).pyramid.layers(cloud, 0, 2000, config.rim_share)[0]
    moved = layer._replace(points=transform_points(T, layer.points))
    expected = point_fits(moved, np.eye(3), np.zeros(3))
    assert (expected > 0.1).sum() > 200
    np.testing.assert_allclose(point_fits(layer, np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()), expected, atol=1e-9)


def test_nothing_is_lost_where_nothing_moves(room: Any, start: FloatArray) -> None:
    rng, config = np.random.default_rng(4), RegistrationConfig()
    scan = room.scan(start, rng)
    cloud = prepare(scan, 2000, planar=False, centre=np.zeros(3))
    layers = Target.build(scan, config).pyramid.layers(cloud, 0, 2000, config.rim_share)
    assert ScoreLoss(layers, np.eye(4)).loss(np.zeros(6)) == 0.0
