# SPDX-License-Identifier: Apache-2.0
"""What the profile ``real`` adds, effect by effect, and that ``ideal`` stays what it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_core.config import from_mapping
from slam_simulation import Scenario, Simulator
from slam_simulation.rendering.shutter import pixel_velocity, rolled, stepped
from slam_simulation.rendering.smoke import SmokeConfig, echo_through, seen_through
from slam_simulation.sensors.profiles import REAL, RealismConfig
from slam_simulation.sensors.tof_errors import TofErrorConfig, wiggle, with_indirect_light
from slam_simulation.world.finishes import FinishConfig, finished
from slam_simulation.world.moving import MovingConfig, MovingThings
from slam_simulation.world.surface_table import Look


def under(scenario: Scenario, **effects: object) -> Scenario:
    realism = from_mapping(RealismConfig, {key.replace("__", "."): value for key, value in effects.items()})
    return replace(scenario, suite=replace(scenario.suite, realism=realism))


def test_profiles_are_named_and_ideal_changes_nothing(scenario: Scenario) -> None:
    assert scenario.with_profile("ideal").suite == scenario.suite
    assert scenario.with_profile("real").suite.realism == REAL
    assert scenario.with_profile("real").suite.stereo.calibration_pictures == 20
    with pytest.raises(ValueError, match="unknown profile 'hard', known: ideal, real"):
        scenario.with_profile("hard")


def test_a_scenario_file_may_name_its_profile_or_single_effects() -> None:
    plan = {
        "seed": 1,
        "rate": 2.0,
        "frames": 2,
        "rooms": [{"name": "a", "x": [0, 4], "y": [0, 4]}],
        "agents": [{"path": [[1, 1], [2, 2]]}],
    }
    assert Scenario.from_mapping("plain", plan).profile == ""
    assert Scenario.from_mapping("hard", plan | {"profile": "real"}).suite.realism == REAL
    smoky = Scenario.from_mapping("smoky", plan | {"realism": {"smoke.density": 0.3}})
    assert smoky.suite.realism == RealismConfig(smoke=SmokeConfig(0.3))


def test_a_real_frame_differs_from_the_ideal_one_and_is_the_same_every_time(scenario: Scenario) -> None:
    ideal, hard, again = (
        next(Simulator(scenario.with_profile(profile), threads=1).run(1)) for profile in ("ideal", "real", "real")
    )
    assert np.abs(hard.left.astype(int) - ideal.left).mean() > 2.0
    np.testing.assert_array_equal(hard.left, again.left)
    np.testing.assert_array_equal(hard.tof.range, again.tof.range)


def test_people_walk_and_chairs_are_moved_and_nothing_else(scenario: Scenario) -> None:
    simulator = Simulator(under(scenario, moving__people=1, moving__moved_chairs=1), threads=1)
    things = MovingThings(simulator.scenario.suite.realism.moving, simulator.path)
    start, later = things.at(simulator.world, 0.0), things.at(simulator.world, 9.0)
    moved = np.linalg.norm(later.origin - start.origin, axis=1)
    assert np.flatnonzero(moved > 1e-9).min() == len(moved) - 24 - 36
    assert (moved[-60:] > 0.05).all()
    np.testing.assert_allclose(np.linalg.norm(later.edge_u, axis=1), np.linalg.norm(start.edge_u, axis=1))
    np.testing.assert_allclose(start.origin, simulator.world.origin, atol=1e-12)
    chair = slice(len(moved) - 36, len(moved))
    before, after = (things.at(simulator.world, t).origin[chair] for t in (1.0, 4.0))
    np.testing.assert_array_equal(before, start.origin[chair])
    np.testing.assert_array_equal(after, before)


def test_a_person_is_seen(scenario: Scenario) -> None:
    frames = [
        next(Simulator(s, threads=1, truth=True).run(first=19, frames=20))
        for s in (scenario, under(scenario, moving__people=1))
    ]
    nearer = frames[1].truth.depth < frames[0].truth.depth - 0.05
    assert nearer.mean() > 0.005


def test_nobody_walks_into_the_rig(scenario: Scenario) -> None:
    path = scenario.path()
    things = MovingThings(MovingConfig(people=2), path)
    gaps = [
        np.linalg.norm(things.person(k, t)[:2, 3] - path.pose(t)[:2, 3])
        for k in (0, 1)
        for t in np.arange(0.0, path.duration, 0.1)
    ]
    assert 1.0 < min(gaps) < 2.5


def test_finishes_change_the_share_asked_for(simulator: Simulator) -> None:
    table = finished(simulator.world, FinishConfig(dark=0.3, shiny=0.2), seed=3)
    before, after = simulator.world.look, table.look
    plain = before[:, Look.EMISSION] == 0.0
    assert np.mean(after[plain, Look.BRIGHTNESS] < before[plain, Look.BRIGHTNESS]) == pytest.approx(0.3, abs=0.1)
    assert np.mean(after[plain, Look.GLOSS] > before[plain, Look.GLOSS]) == pytest.approx(0.2, abs=0.1)
    np.testing.assert_array_equal(after[~plain], before[~plain])


def test_smoke_takes_contrast_and_echo_with_distance() -> None:
    image = np.array([[0.2, 0.8], [0.2, 0.8]], np.float32)
    depth = np.array([[1.0, 1.0], [10.0, 10.0]], np.float32)
    contrast = np.diff(seen_through(image, depth, SmokeConfig(0.3)), axis=1).ravel()
    np.testing.assert_allclose(contrast, 0.6 * np.exp([-0.3, -3.0]), rtol=1e-5)
    phasor = np.full((2, 2), 100.0 + 0j)
    left = echo_through(phasor, depth.astype(float), 7.5, 0.0, SmokeConfig(0.3))
    np.testing.assert_allclose(np.abs(left[:, 0]), 100.0 * np.exp([-0.6, -6.0]))


def test_backscatter_pulls_far_dark_ranges_near() -> None:
    phase = 2.0 * np.pi * 5.0 / 7.5
    far = np.full((1, 1), 20.0 * np.exp(1j * phase))
    seen = np.angle(echo_through(far, np.full((1, 1), 5.0), 7.5, 1000.0, SmokeConfig(0.2)))
    assert np.mod(seen, 2 * np.pi).item() * 7.5 / (2 * np.pi) < 4.5


def test_multipath_lengthens_and_wiggling_repeats() -> None:
    phasor = np.full((64, 64), 100.0 * np.exp(2j * np.pi * 2.0 / 7.5))
    error = np.angle(with_indirect_light(phasor, 7.5, TofErrorConfig(multipath=0.05)) / phasor) * 7.5 / (2 * np.pi)
    assert 0.005 < error[32, 32] < 0.05
    config = TofErrorConfig(wiggling=0.006)
    ranges = np.linspace(1.0, 2.875, 50)
    assert np.abs(wiggle(ranges, 7.5, config)).max() == pytest.approx(0.006, rel=0.01)
    np.testing.assert_allclose(wiggle(ranges + 1.875, 7.5, config), wiggle(ranges, 7.5, config), atol=1e-12)


def test_rows_are_taken_one_after_the_other(simulator: Simulator) -> None:
    rays = simulator.stereo.rays[0]
    height, width = rays.rays.shape[:2]
    columns = np.tile(np.arange(width, dtype=np.float32), (height, 1))
    depth = np.full((height, width), 2.0, np.float32)
    velocity = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    du, dv = pixel_velocity(depth, rays, velocity)
    assert du[height // 2, width // 2] == pytest.approx(-0.2 * simulator.stereo.infos[0].camera.fx, rel=0.02)
    image = rolled(columns, depth, rays, velocity, 0.03)
    middle = width // 2
    assert image[height // 2, middle] == pytest.approx(middle, abs=0.1)
    expected = middle + 0.015 * 0.2 * simulator.stereo.infos[0].camera.fx
    assert image[height - 1, middle] == pytest.approx(expected, rel=0.01)
    assert image[0, middle] == pytest.approx(2 * middle - expected, rel=0.01)
    assert np.abs(dv[height // 2, middle]) < 1.0


def test_exposure_moves_in_steps() -> None:
    gains = np.array([stepped(g, 1.0 / 3.0) for g in np.linspace(0.5, 2.0, 400)])
    assert len(np.unique(gains.round(9))) == 7
    assert stepped(0.7312, 0.0) == 0.7312


def test_a_companion_stays_with_the_rig_and_is_seen(scenario: Scenario) -> None:
    path = scenario.path()
    things = MovingThings(MovingConfig(companions=1), path)
    for t in np.arange(0.0, path.duration, 0.5):
        assert 1.1 < np.linalg.norm(things.companion(0, t)[:2, 3] - path.pose(t)[:2, 3]) < 1.3
    frames = [
        next(Simulator(s, threads=1, truth=True).run(first=10, frames=11))
        for s in (scenario, under(scenario, moving__companions=1))
    ]
    assert (frames[1].truth.depth < frames[0].truth.depth - 0.05).mean() > 0.03
