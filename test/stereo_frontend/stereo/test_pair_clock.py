# SPDX-License-Identifier: Apache-2.0
"""The time between the images of a pair, from matches of a simulated walk whose offset is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.geometry import invert_transform, make_transform, so3_exp, transform_points
from stereo_frontend.stereo.disparity import RefinedDisparity
from stereo_frontend.stereo.pair_clock import PairClock, PairClockConfig

STEREO = StereoCamera(Camera(640, 480, 300.0, 300.0, 320.0, 240.0), 0.12)
NOISE = 0.1


def walk(t: float) -> np.ndarray:
    """Pose of the left camera in the world: forwards, with the sway and the turns of a walker."""
    w = 2.0 * np.pi
    turn = np.array([0.02 * np.sin(1.7 * w * t), 0.3 * np.sin(0.2 * w * t), 0.01 * np.sin(0.85 * w * t)])
    return make_transform(so3_exp(turn), np.array([0.02 * np.sin(0.85 * w * t), 0.01 * np.sin(1.7 * w * t), 0.7 * t]))


def glide(t: float) -> np.ndarray:
    """Straight ahead at constant speed."""
    return make_transform(np.eye(3), np.array([0.0, 0.0, 2.0 * t]))


def stand(t: float) -> np.ndarray:
    return np.eye(4)


def followed(
    late_s: float,
    config: PairClockConfig | None = None,
    frames: int = 40,
    seed: int = 0,
    path: Callable[[float], np.ndarray] = walk,
    right: np.ndarray | None = None,
) -> tuple[PairClock, list[float]]:
    """The clock after matches of a walk, and the root mean square error of the corrected disparities of each frame.

    ``right``: pose (4, 4) of the right camera beyond its calibration.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-6.0, -3.0, 0.5], [6.0, 3.0, 12.0], (1500, 3))
    clock, errors, c = PairClock(config), [], STEREO.camera
    beside = make_transform(np.eye(3), np.array([STEREO.baseline, 0.0, 0.0])) @ (np.eye(4) if right is None else right)
    for k in range(frames):
        t = 0.1 * k
        ahead = points + np.array([0.0, 0.0, walk(t)[2, 3]])
        left, late = (transform_points(invert_transform(T), ahead) for T in (path(t), path(t + late_s) @ beside))
        uv, uv_right = c.project(left), c.project(late)
        inside = ((uv > 5) & (uv < [635, 475]) & (uv_right > 5) & (uv_right < [635, 475])).all(axis=1)
        seen = np.flatnonzero(inside & (left[:, 2] > 0.8))[:200]
        n = len(seen)
        moved = uv[seen] - uv_right[seen] + NOISE * rng.standard_normal((n, 2))
        one = np.full(n, NOISE, np.float32)
        values = moved[:, 0].astype(np.float32), one, np.ones(n, np.float32), -moved[:, 1].astype(np.float32), one
        alignments = RefinedDisparity(*values)
        motion = None if k == 0 else invert_transform(path(t)) @ path(t - 0.1)
        clock.move(round(1e9 * (1.0 + t)), motion, 0.1 if k else 0.0)
        partner = uv[seen] - np.column_stack([alignments.disparity, -alignments.row_shift])
        shift = clock.shift(STEREO, partner, alignments.disparity)
        disparity = shift.without(alignments).disparity
        clock.learn(STEREO, uv[seen], alignments, disparity)
        truth = c.fx * STEREO.baseline / left[seen, 2]
        errors.append(float(np.sqrt(np.mean((disparity - truth) ** 2))))
    return clock, errors


@pytest.mark.parametrize("late_s", [0.008, -0.008, 0.02])
def test_the_offset_of_a_walk_is_found(late_s: float) -> None:
    clock, errors = followed(late_s)
    offset, sigma = clock.learnt
    assert offset == pytest.approx(late_s, abs=1e-3)
    assert abs(offset - late_s) < 3.0 * sigma < 3e-3
    assert clock.time_offset == offset
    assert clock.finding == (offset, sigma)
    assert f"{abs(1e3 * offset):.1f}" in clock.advice()
    assert ("after" in clock.advice()) == (late_s > 0.0)
    assert clock.figures()["right_image_late_ms"] == 1e3 * offset
    without = followed(late_s, PairClockConfig(sigma_time_offset=0.0))[1]
    # What is left is the noise of a match, and the error of a walker's velocity that is predicted from steps before.
    assert np.mean(errors[-20:]) < NOISE * (1.0 + 50.0 * abs(late_s))
    assert np.mean(without[-20:]) > 3.0 * np.mean(errors[-20:])


def test_images_of_one_moment_have_no_offset() -> None:
    for seed in range(4):
        clock, _ = followed(0.0, seed=seed)
        assert clock.time_offset == 0.0
        assert clock.finding == (0.0, 0.0)
        assert clock.advice() == clock.diagnostic == ""
        assert abs(clock.learnt[0]) < 5.0 * clock.learnt[1]


def test_a_right_camera_that_stands_ahead_is_not_taken_for_a_late_one() -> None:
    """At constant speed straight ahead the two look the same: then nothing is believed."""
    for path in (glide, walk):
        clock, _ = followed(0.0, path=path, right=make_transform(np.eye(3), np.array([0.0, 0.0, 0.003])), frames=25)
        assert not clock.is_believed
        assert clock.figures()


def test_a_bad_calibration_is_not_taken_for_a_late_image() -> None:
    turned = make_transform(so3_exp(np.radians([0.2, 0.1, 0.15])), np.zeros(3))
    clock, _ = followed(0.0, right=turned)
    assert not clock.is_believed
    clock, _ = followed(0.008, right=turned)
    assert clock.learnt[0] == pytest.approx(0.008, abs=1e-3)


def test_a_rig_that_stands_tells_nothing() -> None:
    clock, _ = followed(0.008, path=stand)
    assert clock.figures() == {}
    assert clock.learnt == (0.0, 0.02)


def test_a_known_offset_is_used_from_the_second_frame_on_and_stays() -> None:
    known = PairClockConfig(time_offset=0.008, sigma_time_offset=0.0)
    clock, errors = followed(0.008, known)
    assert clock.time_offset == 0.008
    assert clock.figures() == {}
    assert max(errors[2:]) < 2.0 * NOISE
    wrong, _ = followed(0.0, PairClockConfig(time_offset=0.008, sigma_time_offset=0.005))
    assert wrong.time_offset == pytest.approx(0.0, abs=1e-3)
    assert not wrong.is_believed


def test_the_first_frame_under_a_known_offset_is_as_unsure_as_its_velocity() -> None:
    clock = PairClock(PairClockConfig(time_offset=0.008, sigma_time_offset=0.0))
    clock.move(1, None, 0.0)
    shift = clock.shift(STEREO, np.full((3, 2), 300.0), np.full(3, 12.0))
    assert not shift.uv.any()
    np.testing.assert_allclose(shift.sigma, 0.008 * 300.0 * 0.5 * np.hypot(1.0, 1.0 / 3.0), rtol=0.02)
    assert not PairClock().shift(STEREO, np.full((3, 2), 300.0)).sigma.any()


def test_a_gap_ends_the_motion_and_a_reset_forgets_all() -> None:
    clock, _ = followed(0.02)
    nowhere = np.full((3, 2), 300.0)
    assert clock.shift(STEREO, nowhere).uv.any()
    clock.move(10_000_000_000, None, 0.0)
    assert not clock.shift(STEREO, nowhere).uv.any()
    clock.move(10_000_000_000, np.eye(4), 0.1)
    assert not clock.shift(STEREO, nowhere).uv.any()
    clock.reset()
    assert clock.learnt == (0.0, 0.02)
    assert not clock.is_believed


def test_what_moves_far_between_the_images_is_degraded() -> None:
    clock, _ = followed(0.02)
    clock.move(round(5e9), make_transform(so3_exp(np.array([0.0, 0.2, 0.0])), np.zeros(3)), 0.1)
    clock.shift(STEREO, np.full((3, 2), 300.0))
    assert "between the images" in clock.diagnostic


def test_a_known_offset_is_as_unsure_as_an_unknown_one_of_that_size() -> None:
    """Velocities that are wrong by a share make the whole offset wrong by it, however much was known before."""
    found, _ = followed(0.02)
    known, _ = followed(0.02, PairClockConfig(time_offset=0.02, sigma_time_offset=0.02))
    assert known.learnt[1] == pytest.approx(found.learnt[1], rel=0.1)
    assert known.advice() == ""
    wrong, _ = followed(0.02, PairClockConfig(time_offset=0.01, sigma_time_offset=0.02))
    assert "refine again" in wrong.advice()


def test_a_warning_ends_with_its_cause() -> None:
    clock, _ = followed(0.02)
    clock.move(round(5e9), make_transform(so3_exp(np.array([0.0, 0.2, 0.0])), np.zeros(3)), 0.1)
    clock.shift(STEREO, np.full((3, 2), 300.0))
    clock.move(round(5.1e9), np.eye(4), 0.1)
    clock.is_believed = False
    clock.shift(STEREO, np.full((3, 2), 300.0))
    assert clock.diagnostic == ""


def test_without_tracks_no_offset_counts() -> None:
    clock = PairClock(PairClockConfig(time_offset=0.008), tracks=False)
    clock.move(1, None, 0.0)
    assert not clock.shift(STEREO, np.full((3, 2), 300.0), np.full(3, 12.0)).sigma.any()
    assert "8.0 ms, is left out" in clock.advice()
