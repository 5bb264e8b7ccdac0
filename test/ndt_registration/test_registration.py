# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ndt_registration.registration import RegistrationConfig, register
from slam_core.geometry import FloatArray, boxminus, invert_transform, transform_points

MOTIONS = {
    "forward 25 cm": (0.25, 0.0, 0.0),
    "forward 100 cm": (1.0, 0.0, 0.0),
    "sideways 50 cm": (0.0, 0.5, 0.0),
    "(25, 25) cm": (0.25, 0.25, 0.0),
    "yaw 10": (0.0, 0.0, 10.0),
    "yaw -10": (0.0, 0.0, -10.0),
    "yaw 10, 25 cm": (0.25, 0.0, 10.0),
}


def error(T: FloatArray, truth: FloatArray) -> tuple[float, float]:
    d = boxminus(T, truth)
    return float(np.linalg.norm(d[:3])), float(np.rad2deg(np.linalg.norm(d[3:])))


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_one_setting_registers_every_motion_without_a_guess(
    room: Any, start: FloatArray, at: Callable[..., FloatArray], motion: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(5)
    truth = at(motion[0], motion[1], 0.0, motion[2])
    result = register(room.scan(start @ truth, rng), room.scan(start, rng))
    distance, angle = error(result.T_target_source, truth)
    assert result.converged, result.reason
    assert distance < 0.01
    assert angle < 0.3
    assert result.degenerate == ()


def test_half_of_the_view_is_enough(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    truth = at(0.0, 0.0, 0.0, 20.0)
    result = register(room.scan(start @ truth, rng), room.scan(start, rng))
    distance, angle = error(result.T_target_source, truth)
    assert result.converged, result.reason
    assert distance < 0.05
    assert angle < 1.0


@pytest.mark.parametrize("method", ["icp", "icp_plane"])
def test_icp_from_a_guess(room: Any, start: FloatArray, at: Callable[..., FloatArray], method: str) -> None:
    rng = np.random.default_rng(5)
    truth = at(0.2, 0.1, 0.0, 5.0)
    config = RegistrationConfig(method=method)
    result = register(room.scan(start @ truth, rng, 60), room.scan(start, rng, 60), at(0.15, 0.12, 0.02, 3.0), config)
    distance, angle = error(result.T_target_source, truth)
    assert result.converged, result.reason
    assert distance < 0.03
    assert angle < 0.5


def test_same_clouds_same_bytes(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    source, target = room.scan(start @ at(0.1, 0.0), rng, 60), room.scan(start, rng, 60)
    first, second = register(source, target), register(source, target)
    assert first.T_target_source.tobytes() == second.T_target_source.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_map_coordinates_far_from_the_origin(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    truth = at(0.1, 0.05, 0.0, 2.0)
    away = at(4000.0, -3000.0, 100.0, 40.0)
    source, target = (transform_points(away, room.scan(T, rng)) for T in (start @ truth, start))
    result = register(source, target)
    expected = away @ truth @ invert_transform(away)
    centre = source.mean(axis=0, keepdims=True)
    moved, wanted = (transform_points(T, centre) for T in (result.T_target_source, expected))
    assert np.linalg.norm(moved - wanted) < 0.02


def test_a_corridor_leaves_its_axis_free_and_says_so(empty_room: Any, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    corridor = empty_room(60.0, 2.0, 2.4)
    start, truth = at(5.0, 1.0, 1.2), at(0.2, 0.05, 0.0, 2.0)
    source, target = corridor.scan(start @ truth, rng), corridor.scan(start, rng)
    near = [cloud[np.linalg.norm(cloud, axis=1) < 7.5] for cloud in (source, target)]
    result = register(near[0], near[1], np.eye(4))
    assert len(result.degenerate) == 1
    assert result.degenerate[0].startswith("translation along (1.00")
    assert result.covariance[0, 0] > 1.0
    assert result.covariance[1, 1] < 0.01 * result.covariance[0, 0]
    d = boxminus(result.T_target_source, truth)
    assert abs(d[1]) < 0.02


def test_a_single_wall_leaves_three_directions_free(empty_room: Any, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    wall = empty_room(60.0, 60.0, 60.0)
    start, truth = at(57.0, 30.0, 30.0), at(0.2, 0.0, 0.0, 2.0)
    result = register(wall.scan(start @ truth, rng), wall.scan(start, rng), np.eye(4))
    assert len(result.degenerate) == 3
    assert result.covariance[1, 1] > 1.0
    assert result.covariance[2, 2] > 1.0
    assert abs(boxminus(result.T_target_source, truth)[4]) < 0.01


BAD = {
    "empty": (np.empty((0, 3)), "0 finite points"),
    "NaN": (np.full((900, 3), np.nan), "0 finite points"),
    "one point": (np.ones((1, 3)), "1 finite points"),
    "coincident": (np.ones((900, 3)), "coincide"),
    "beyond all numbers": (1e200 * np.eye(3).repeat(300, axis=0), "spans 1e+200 m"),
}


@pytest.mark.parametrize("method", ["ndt", "icp", "icp_plane"])
@pytest.mark.parametrize(("cloud", "reason"), BAD.values(), ids=BAD.keys())
def test_bad_clouds_give_a_reason(room: Any, start: FloatArray, cloud: FloatArray, reason: str, method: str) -> None:
    good, config = room.scan(start, np.random.default_rng(5), 40), RegistrationConfig(method=method)
    for result in (register(cloud, good, config=config), register(good, cloud, config=config)):
        assert not result.converged
        assert reason in result.reason
        assert np.isfinite(result.covariance).all()


@pytest.mark.parametrize("method", ["ndt", "icp", "icp_plane"])
def test_points_on_a_line_are_no_plain_success(method: str) -> None:
    line = np.outer(np.linspace(0.0, 5.0, 2000), [1.0, 0.0, 0.0])
    result = register(line, line, config=RegistrationConfig(method=method))
    assert result.degenerate or not result.converged


@pytest.mark.parametrize("method", ["ndt", "icp", "icp_plane"])
def test_thousands_of_points_in_two_places_are_no_plain_success(method: str) -> None:
    """A kd-tree of points that coincide searches all of them for each: that would take minutes."""
    places = np.repeat([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], 3000, axis=0)
    result = register(places, places, config=RegistrationConfig(method=method))
    assert result.degenerate or not result.converged


@pytest.mark.parametrize("stray_in_target", [False, True])
def test_a_stray_point_does_no_harm(
    room: Any, start: FloatArray, at: Callable[..., FloatArray], stray_in_target: bool
) -> None:
    rng, truth = np.random.default_rng(5), at(0.1, 0.0, 0.0, 3.0)
    source, target = room.scan(start @ truth, rng), room.scan(start, rng)
    if stray_in_target:
        target = np.vstack([target, [1e9, 0.0, 0.0]])
    else:
        source = np.vstack([source, [1e9, 0.0, 0.0]])
    result = register(source, target)
    assert result.converged, result.reason
    assert error(result.T_target_source, truth)[0] < 0.01


def test_covariance_stays_positive_definite_in_map_coordinates(room: Any, start: FloatArray) -> None:
    rng = np.random.default_rng(5)
    away = np.array([5e5, 4e6, 0.0])
    result = register(room.scan(start, rng) + away, room.scan(start, rng) + away, np.eye(4))
    np.linalg.cholesky(result.covariance)


@pytest.mark.parametrize("method", ["ndt", "icp_plane"])
def test_coplanar_points_are_no_plain_success(method: str) -> None:
    rng = np.random.default_rng(5)
    sheet = np.column_stack([np.full(2000, 2.0), rng.uniform(-1, 1, (2000, 2))])
    result = register(sheet, sheet + np.array([0.1, 0.0, 0.0]), config=RegistrationConfig(method=method))
    assert result.degenerate or not result.converged


def test_clouds_without_overlap_do_not_converge(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    result = register(rng.normal(size=(3000, 3)) * [3.0, 0.2, 1.0] + [9.0, 0.0, 0.0], room.scan(start, rng), np.eye(4))
    assert not result.converged
    assert "%" in result.reason or "free" in result.reason


def test_a_million_points(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    truth = at(0.1, 0.0, 0.0, 3.0)
    source, target = (np.tile(room.scan(T, rng, 100), (100, 1)) for T in (start @ truth, start))
    result = register(source, target)
    assert result.converged
    assert error(result.T_target_source, truth)[0] < 0.02


def test_plane_motion_from_laser_scans(at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    corners = np.array([[-3, -2], [4, -2], [4, 1], [2, 1], [2, 3], [-1, 3], [-1, 2], [-3, 2], [-3, -2]], dtype=float)
    walls = np.concatenate([a + np.linspace(0, 1, 150)[:, None] * (b - a) for a, b in pairwise(corners)])
    truth = at(0.3, -0.2, 0.0, 12.0)
    cloud = np.column_stack([walls, np.zeros(len(walls))])
    source = transform_points(invert_transform(truth), cloud)[:, :2] + 0.005 * rng.normal(size=walls.shape)
    result = register(source, walls + 0.005 * rng.normal(size=walls.shape))
    distance, angle = error(result.T_target_source, truth)
    assert result.converged, result.reason
    assert distance < 0.01
    assert angle < 0.3
    assert result.T_target_source[2, 3] == 0.0


def test_a_turning_laser_scanner_with_infinite_ranges(at: Callable[..., FloatArray]) -> None:
    """720 beams in a room with two pillars; every seventh hits nothing."""
    rng = np.random.default_rng(5)
    corners = np.array([[-4, -3], [6, -3], [6, 5], [-4, 5]], dtype=float)
    walls = [(corners[k], corners[(k + 1) % 4] - corners[k]) for k in range(4)]
    for x, y in ((2.0, 1.0), (-3.0, 2.0)):
        box = np.array([[x, y], [x + 0.9, y], [x + 0.9, y + 0.7], [x, y + 0.7]])
        walls += [(box[k], box[(k + 1) % 4] - box[k]) for k in range(4)]

    def scan(T: FloatArray) -> FloatArray:
        angles = np.deg2rad(np.arange(0.0, 360.0, 0.5))
        beams = np.column_stack([np.cos(angles), np.sin(angles)])
        turned, ranges = beams @ T[:2, :2].T, np.full(len(beams), np.inf)
        for corner, edge in walls:
            d, cross = corner - T[:2, 3], turned[:, 0] * edge[1] - turned[:, 1] * edge[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (d[0] * edge[1] - d[1] * edge[0]) / cross
                along = (d[0] * turned[:, 1] - d[1] * turned[:, 0]) / cross
            ranges = np.where((distance > 0) & (along >= 0) & (along <= 1) & (distance < ranges), distance, ranges)
        points = beams * (ranges + 0.01 * rng.normal(size=len(beams)))[:, None]
        points[::7] = np.inf
        return points

    truth = at(0.4, 0.2, 0.0, 8.0)
    result = register(scan(truth), scan(np.eye(4)))
    distance, angle = error(result.T_target_source, truth)
    assert result.converged, result.reason
    assert distance < 0.01
    assert angle < 0.3


@pytest.mark.parametrize("guess", [np.eye(3), np.full((4, 4), np.nan), 2.0 * np.eye(4)])
def test_a_guess_that_is_no_transform_is_an_error(room: Any, start: FloatArray, guess: FloatArray) -> None:
    cloud = room.scan(start, np.random.default_rng(5), 40)
    with pytest.raises(ValueError, match="rigid"):
        register(cloud, cloud, guess)


def test_wrong_shapes_are_an_error() -> None:
    with pytest.raises(ValueError, match="shape"):
        register(np.ones((10, 4)), np.ones((10, 3)))


@pytest.mark.parametrize("factors", [(1000.0, 1.0), (1.0, 1000.0)])
def test_a_cloud_in_millimetres_is_noticed(room: Any, start: FloatArray, factors: tuple[float, float]) -> None:
    rng = np.random.default_rng(6)
    source, target = (factor * room.scan(start, rng) for factor in factors)
    result = register(source, target)
    assert not result.converged
    assert result.reason.endswith("is one of them in mm?")
