# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter: its readout is found from a shaken camera's own frames, and features are moved to one instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig, MeasurementConfig
from ekf_slam_node.filtering.models import Frame, frame_from_features
from ekf_slam_node.slam import EkfSlam
from ekf_slam_node.submaps.rolling_shutter import RollingShutter, _robust_mean
from feature_world import CAMERA, T_RIG_OPTICAL, PointWorld, room
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_exp, transform_points
from slam_core.types import Features

RATE, READOUT_S = 20.0, 0.025


def pose(t: float) -> FloatArray:
    """T_world_rig of a camera that is shaken while it pans."""
    turn = np.array([0.1 * np.sin(5.0 * t), 0.12 * np.sin(6.0 * t + 1.0), 0.3 * np.sin(4.0 * t)])
    return make_transform(so3_exp(turn), 0.2 * np.sin([1.7 * t, 2.9 * t, 2.3 * t]))


def seen(points: FloatArray, t: float) -> FloatArray:
    """u, v, depth (n, 3) of points at a time."""
    optical = transform_points(invert_transform(pose(t) @ T_RIG_OPTICAL), points)
    return np.column_stack([CAMERA.project(optical), optical[:, 2]])


def rolled(points: FloatArray, t: float, readout_s: float) -> FloatArray:
    """The same with rows exposed one after the other, the middle one at ``t``."""
    now = seen(points, t)
    for _ in range(3):
        late = readout_s * (now[:, 1] - 239.5) / 480.0
        now = np.vstack([seen(p[None], t + dt) for p, dt in zip(points, late, strict=True)])
    return now


def features(world: PointWorld, t: float, readout_s: float, rng: np.random.Generator) -> tuple[Features, np.ndarray]:
    found, index = world.features(pose(t), round(1e9 * t), rng, max_features=120)
    moved = rolled(world.points[index], t, readout_s) - seen(world.points[index], t)
    uv = (found.uv + moved[:, :2]).astype(np.float32)
    return replace(found, uv=uv, depth=found.depth + moved[:, 2].astype(np.float32)), index


def measured(world: PointWorld, t: float, readout_s: float, rng: np.random.Generator) -> tuple[Frame, np.ndarray]:
    found, index = features(world, t, readout_s, rng)
    return frame_from_features(found, np.arange(len(found)), 0.05, 1e-4), index


def motion(k: int) -> FloatArray:
    return invert_transform(pose((k - 1) / RATE)) @ pose(k / RATE)


def learnt(
    readout_s: float, rng: np.random.Generator, frames: int = 60, known: tuple[float, float] = (0.0, 0.0)
) -> tuple[RollingShutter, PointWorld]:
    world, shutter = room(rng), RollingShutter(T_RIG_OPTICAL, known)
    for k in range(1, frames):
        frame, index = measured(world, k / RATE, readout_s, rng)
        shutter.learn(frame, index, np.arange(len(frame)), motion(k), 1.0 / RATE)
    return shutter, world


@pytest.mark.parametrize("readout_s", [READOUT_S, -READOUT_S])
def test_the_readout_is_found_in_either_direction(readout_s: float, rng: np.random.Generator) -> None:
    shutter, _ = learnt(readout_s, rng)
    assert shutter.readout_s == pytest.approx(readout_s, abs=0.004)


def test_features_are_moved_to_the_instant_of_the_middle_row(rng: np.random.Generator) -> None:
    shutter, world = learnt(READOUT_S, rng)
    t = 60 / RATE
    frame, index = measured(world, t, READOUT_S, rng)
    true = seen(world.points[index], t)
    exact = replace(frame, z=np.column_stack([rolled(world.points[index], t, READOUT_S)[:, :2], 1.0 / true[:, 2]]))
    before = np.linalg.norm(exact.z[:, :2] - true[:, :2], axis=1)
    after = np.linalg.norm(shutter.corrected(exact, 1.0 / RATE, motion(60)).z[:, :2] - true[:, :2], axis=1)
    assert np.sqrt(np.mean(after**2)) < 0.35 * np.sqrt(np.mean(before**2))
    assert np.sqrt(np.mean(before**2)) > 1.0


def test_what_is_known_beforehand_holds_from_the_first_frame_on(rng: np.random.Generator) -> None:
    shutter, world = RollingShutter(T_RIG_OPTICAL, (READOUT_S, 0.001)), room(rng)
    frame, _ = measured(world, 1 / RATE, READOUT_S, rng)
    assert (shutter.readout_s, shutter.sigma_s) == (READOUT_S, 0.001)
    assert np.abs(shutter.corrected(frame, 1.0 / RATE, motion(1)).z - frame.z)[:, :2].max() > 1.0


def test_frames_outweigh_what_is_known_less_well(rng: np.random.Generator) -> None:
    alone, _ = learnt(READOUT_S, rng)
    vague, _ = learnt(READOUT_S, rng, known=(0.0, 0.01))
    sure, _ = learnt(READOUT_S, rng, known=(0.01, 1e-4))
    assert vague.readout_s == pytest.approx(READOUT_S, abs=0.004)
    assert sure.readout_s == pytest.approx(0.01, abs=0.001)
    assert sure.sigma_s < 1e-4 < vague.sigma_s < 1.5 * alone.sigma_s


def test_a_readout_without_its_sigma_is_refused() -> None:
    with pytest.raises(ValueError, match="'readout' is given without 'sigma_readout'"):
        MeasurementConfig(readout=0.02)


def test_rows_exposed_at_once_are_left_alone(rng: np.random.Generator) -> None:
    shutter, world = learnt(0.0, rng)
    frame, _ = measured(world, 60 / RATE, 0.0, rng)
    assert shutter.readout_s == 0.0
    assert shutter.corrected(frame, 1.0 / RATE, motion(60)) is frame


def test_a_few_pairs_that_agree_by_chance_prove_nothing(rng: np.random.Generator) -> None:
    alike = 0.005 + 1e-4 * rng.standard_normal(16)
    mean, standard_error = _robust_mean(alike, np.full(16, 0.005))
    assert mean == pytest.approx(0.005, abs=2e-4)
    assert standard_error == pytest.approx(0.005 / 4.0)


def test_pairs_that_are_equal_have_a_mean_all_the_same() -> None:
    values = np.array([0.0] * 12 + [0.02] * 4)
    mean, standard_error = _robust_mean(values, np.full(16, 0.005))
    assert mean == pytest.approx(0.0, abs=1e-9)
    assert standard_error >= 0.005 / 4.0 - 1e-12


def test_a_frame_that_does_not_follow_the_last_takes_no_velocity_from_it(rng: np.random.Generator) -> None:
    shutter, world = learnt(READOUT_S, rng)
    frame, _ = measured(world, 70 / RATE, READOUT_S, rng)
    assert shutter.corrected(frame, 1.0 / RATE) is frame


def test_the_filter_is_nearer_to_the_truth_once_it_knows(rng: np.random.Generator) -> None:
    world, slam, errors = room(rng), EkfSlam(EkfSlamConfig(), T_RIG_OPTICAL), []
    for k in range(80):
        last = slam.process(features(world, k / RATE, READOUT_S, rng)[0])
        errors.append(boxminus(invert_transform(pose(0.0)) @ pose(k / RATE), last.pose.T))
    steps = np.linalg.norm(np.diff(np.array(errors), axis=0)[:, 3:], axis=1)
    assert slam.readout_s[0] == pytest.approx(READOUT_S, abs=0.005)
    assert 1e-4 < slam.readout_s[1] < 0.005
    assert np.median(steps[40:]) < 0.6 * np.median(steps[:15])
