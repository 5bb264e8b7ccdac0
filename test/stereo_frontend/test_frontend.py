# SPDX-License-Identifier: Apache-2.0
"""The whole front end on synthetic frames with known depth, in every mode, and on bad frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.config import from_mapping
from slam_core.geometry import make_transform, so3_exp
from slam_core.types import DepthImage, FeatureSource, StereoImages
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import FrontendConfig

DEPTH = 200.0 * 0.12 / 12.3
FIELDS = ("xyz", "uv", "depth", "sigma_uv", "sigma_depth", "response", "source", "descriptors")
IDENTITY = np.eye(4)


def frontend(mode: str = "stereo", **options) -> Frontend:
    return Frontend(from_mapping(FrontendConfig, {"mode": mode, "features.target": 300, **options}))


def tof_image(
    pair: StereoImages, depth: float = DEPTH, sigma: float = 0.004, stamp_ns: int = 1_000_000_000
) -> DepthImage:
    """A depth camera in the place of the left one, seeing its middle."""
    camera = Camera(160, 120, 200.0, 200.0, 80.0, 60.0)
    noise = np.random.default_rng(4).normal(0, sigma, (120, 160))
    values = (depth + noise).astype(np.float32)
    amplitude = pair.left[60:180, 80:240].astype(np.float32)
    return DepthImage(stamp_ns, values, np.full_like(values, sigma), camera, amplitude)


def test_stereo_depth_is_right_and_its_sigma_true(stereo_pair):
    pictures = [frontend().process(stereo_pair(seed=seed)) for seed in range(1, 9)]
    assert min(len(features) for features in pictures) > 150
    error = np.concatenate([(features.depth - DEPTH) / features.sigma_depth for features in pictures])
    assert 0.6 < 1.4826 * np.median(np.abs(error)) < 1.4
    assert np.mean(np.abs(np.concatenate([f.depth for f in pictures]) / DEPTH - 1) < 0.05) > 0.99
    assert {source for features in pictures for source in features.source} == {FeatureSource.STEREO}
    assert {features.frame_id for features in pictures} == {"stereo_left_optical_frame"}


def test_xyz_uv_and_depth_agree_and_arrays_are_single_precision(stereo_pair):
    features = frontend().process(stereo_pair())
    np.testing.assert_allclose(features.camera.project(features.xyz), features.uv, atol=1e-3)
    np.testing.assert_array_equal(features.xyz[:, 2], features.depth)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    for field in set(FIELDS) - {"source"}:
        assert getattr(features, field).dtype == np.float32
    assert features.source.dtype == np.uint8


@pytest.mark.parametrize("mode", ["stereo", "replace"])
def test_features_are_described_for_other_moments(stereo_pair, mode):
    pair = stereo_pair()
    features = frontend(mode).process(pair, tof_image(pair), IDENTITY)
    every = FeatureExtractor(FeatureConfig(target=300))(pair.left)
    place = {tuple(uv): k for k, uv in enumerate(every.uv)}
    own = every.descriptors[[place[tuple(uv)] for uv in features.uv]]
    np.testing.assert_allclose(features.descriptors, own, atol=1e-4)


def test_features_that_look_alike_are_left_out(stereo_pair):
    pair = stereo_pair()
    halves = {side: getattr(pair, side)[:120] for side in ("left", "right")}
    twice = dataclasses.replace(pair, **{side: np.vstack([half, half]) for side, half in halves.items()})
    once, both = (frontend().process(images) for images in (pair, twice))
    upper = once.uv[:, 1] < 60
    assert upper.sum() > 20
    assert np.sum(both.uv[:, 1] < 60) < 0.4 * upper.sum()


def test_the_same_frames_give_the_same_bytes(stereo_pair):
    runs = []
    for _ in range(2):
        front = frontend()
        runs.append([front.process(stereo_pair(seed=s)) for s in (1, 2, 1)])
    for first, second in zip(*runs, strict=True):
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_reset_forgets(stereo_pair):
    front = frontend()
    first = front.process(stereo_pair())
    front.process(stereo_pair(seed=5, noise=8.0))
    front.reset()
    np.testing.assert_array_equal(front.process(stereo_pair()).descriptors, first.descriptors)
    assert front.counters.counts["frames"] == 1


def test_replace_takes_the_tof_depth_inside_its_view_only(stereo_pair):
    pair = stereo_pair()
    features = frontend("replace").process(pair, tof_image(pair), IDENTITY)
    inside = np.all((features.uv > [84, 64]) & (features.uv < [236, 176]), axis=1)
    outside = np.any((features.uv < [79, 59]) | (features.uv > [241, 181]), axis=1)
    assert inside.sum() > 30
    assert outside.sum() > 30
    assert np.all(features.source[inside] == FeatureSource.TOF)
    assert np.all(features.source[outside] == FeatureSource.STEREO)
    assert np.median(features.sigma_depth[inside]) < 0.003
    assert np.abs(features.depth[inside] - DEPTH).max() < 0.02


def test_fused_depth_has_less_error_than_stereo_and_tof(stereo_pair):
    pair = stereo_pair(noise=6.0)
    tof = tof_image(pair, sigma=0.02)
    errors = {}
    for mode in ("stereo", "replace", "fuse"):
        features = frontend(mode).process(pair, tof, IDENTITY)
        inside = np.all((features.uv > [84, 64]) & (features.uv < [236, 176]), axis=1)
        errors[mode] = np.sqrt(np.mean((features.depth[inside] - DEPTH) ** 2))
    assert errors["fuse"] < min(errors["stereo"], errors["replace"])


def test_a_tof_depth_that_disagrees_does_not_spoil_stereo(stereo_pair):
    pair = stereo_pair()
    features = frontend("fuse").process(pair, tof_image(pair, depth=1.3 * DEPTH), IDENTITY)
    stereo = frontend("stereo").process(pair)
    assert not np.any(features.source == FeatureSource.FUSED)
    shared = np.isin(features.uv[:, 0], stereo.uv[:, 0])
    np.testing.assert_allclose(features.depth[shared], stereo.depth)


def test_a_tof_camera_that_errs_by_an_offset_is_corrected_to_agree_with_stereo(stereo_pair):
    """All searched: where features are followed, uncorrected depths contradict stereo, and none is used."""
    found = {}
    for mode in ("auto", "off"):
        front = frontend("fuse", **{"range_calibration.mode": mode, "features.tracking": "never"})
        for disparity in np.arange(8.0, 14.0, 0.5):
            pair, depth = stereo_pair(disparity=disparity), 200.0 * 0.12 / disparity
            features = front.process(pair, tof_image(pair, depth=depth + 0.05), IDENTITY)
        fused = features.source != FeatureSource.STEREO
        found[mode] = np.abs(np.median(features.depth[fused]) - depth), np.median(features.sigma_depth[fused])
        assert front.report().ranges.get("corrected") == {"auto": "yes", "off": None}[mode]
    assert found["auto"][0] < 0.01
    assert found["auto"][0] < 0.25 * found["off"][0]
    assert found["auto"][1] > found["off"][1]


def test_a_tof_camera_that_errs_is_corrected_where_features_are_followed(stereo_pair):
    front = frontend("fuse")
    for disparity in np.arange(8.0, 14.0, 0.5):
        pair, depth = stereo_pair(disparity=disparity), 200.0 * 0.12 / disparity
        features = front.process(pair, tof_image(pair, depth=depth + 0.05), IDENTITY)
    fused = features.source != FeatureSource.STEREO
    assert front.report().ranges.get("corrected") == "yes"
    assert np.abs(np.median(features.depth[fused]) - depth) < 0.01


def test_how_old_a_depth_image_may_be_is_a_parameter(stereo_pair):
    pair = stereo_pair()
    for max_age, count in ((0.06, "tof_too_old"), (2.0, "fused")):
        front = frontend("fuse", **{"fusion.max_age": max_age})
        front.process(pair, tof_image(pair, stamp_ns=2_000_000_000), IDENTITY)
        assert front.counters.counts[count] > 0


@pytest.mark.parametrize(("stamp_ns", "count"), [(2_000_000_000, "tof_too_old"), (None, "tof_missing")])
def test_without_a_fresh_depth_image_stereo_stands_alone(stereo_pair, stamp_ns, count):
    pair = stereo_pair()
    depth = None if stamp_ns is None else tof_image(pair, stamp_ns=stamp_ns)
    front = frontend("fuse")
    features = front.process(pair, depth, IDENTITY)
    assert set(features.source) == {FeatureSource.STEREO}
    assert front.counters.counts[count] == 1


@pytest.mark.parametrize("images", ["amplitude", "range", "both"])
def test_tof_alone(stereo_pair, images):
    pair = stereo_pair()
    tof = tof_image(pair)
    wavy = tof.depth + 0.1 * (tof.amplitude / 255.0)
    features = frontend("tof", **{"tof.images": images}).process(None, dataclasses.replace(tof, depth=wavy))
    assert len(features) > 20
    assert features.frame_id == "tof_optical_frame"
    assert set(features.source) == {FeatureSource.TOF}
    assert np.all(np.abs(features.depth - DEPTH - 0.05) < 0.07)


def test_any_grey_image_serves_and_range_only_where_there_is_none(stereo_pair):
    tof = tof_image(stereo_pair())
    grey, blank = tof.amplitude, np.zeros_like(tof.amplitude)
    front = frontend("tof")
    for amplitude, intensity, used in ((grey, grey, "amplitude"), (None, grey, "intensity"), (blank, grey, "intensity"),
                                       (None, None, "range"), (blank, None, "range")):  # fmt: skip
        front.process(None, dataclasses.replace(tof, amplitude=amplitude, intensity=intensity))
        assert front.report().picture == used
        assert bool(front.report().advice) == (used == "range")
    chosen = frontend("tof", **{"tof.images": "intensity"})
    features = chosen.process(None, dataclasses.replace(tof, intensity=grey))
    assert chosen.report().picture == "intensity"
    np.testing.assert_array_equal(features.uv, frontend("tof").process(None, tof).uv)


def test_swapped_images_are_named_as_such(stereo_pair):
    pair = stereo_pair()
    swapped = dataclasses.replace(pair, left=pair.right, right=pair.left)
    with pytest.raises(ValueError, match="left and right images are swapped"):
        frontend().process(swapped)


def test_a_camera_that_has_been_right_is_not_swapped_where_noise_matches_by_chance(stereo_pair, monkeypatch):
    pair = stereo_pair()
    seeing = frontend()
    monkeypatch.setattr("stereo_frontend.stereo_depth.swapped_share", lambda *_: (0.62, 58))
    blank = np.random.default_rng(3).normal(128.0, 20.0, (2, *pair.left.shape)).clip(0, 255).astype(np.uint8)
    wall = dataclasses.replace(pair, stamp_ns=pair.stamp_ns + 1, left=blank[0], right=blank[1])
    with pytest.raises(ValueError, match="swapped"):
        frontend().process(wall)
    seeing.process(pair)
    seeing.process(wall)


@pytest.mark.parametrize("grey", [0, 255])
@pytest.mark.parametrize("mode", ["stereo", "fuse"])
def test_black_and_white_frames_give_no_features(stereo_pair, grey, mode):
    pair = stereo_pair()
    blank = dataclasses.replace(pair, left=np.full_like(pair.left, grey), right=np.full_like(pair.right, grey))
    assert len(frontend(mode).process(blank, tof_image(pair), IDENTITY)) == 0


def test_depth_without_a_number_gives_no_tof_features(stereo_pair):
    pair = stereo_pair()
    tof = tof_image(pair)
    nothing = dataclasses.replace(tof, depth=np.full_like(tof.depth, np.nan), sigma=np.full_like(tof.depth, np.nan))
    assert len(frontend("tof").process(None, nothing)) == 0
    assert set(frontend("fuse").process(pair, nothing, IDENTITY).source) == {FeatureSource.STEREO}


def test_missing_inputs_are_named(stereo_pair):
    pair = stereo_pair()
    with pytest.raises(ValueError, match="needs a depth image"):
        frontend("tof").process(pair)
    with pytest.raises(ValueError, match="needs a stereo pair"):
        frontend("fuse").process(None, tof_image(pair), IDENTITY)
    with pytest.raises(ValueError, match="T_left_tof"):
        frontend("fuse").process(pair, tof_image(pair))


LATE = {"features.tracking": "always", "pair.time_offset": 0.01, "pair.sigma_time_offset": 0.0}


def pitched(front: Frontend, row: float) -> None:
    """Tell the clock of a turn by which an image's middle moves by ``row`` px in 10 ms."""
    turn = make_transform(so3_exp(np.array([-0.1 * row / 0.01 / 200.0, 0.0, 0.0])), np.zeros(3))
    front.pair_clock.move(1_000_000_000, turn, 0.1)


def test_motion_between_the_images_is_not_taken_for_an_error_of_the_rectification(stereo_pair):
    pair, front = stereo_pair(row=3.0), frontend(**LATE)
    pitched(front, 3.0)
    estimate, _ = front._stereo_depth.of_keypoints(pair, *front._extract(pair))
    assert np.isfinite(estimate.depth).sum() > 100
    assert front.self_calibration.error.row_rms() < 1.0


def test_rows_that_were_learnt_in_unknown_motion_are_learnt_anew(stereo_pair):
    front = frontend(**LATE)
    front.process(stereo_pair(row=3.0))
    assert front.self_calibration.error.row_rms() == pytest.approx(3.0, abs=0.5)
    found = [len(front._detected(p, front._extract(p), None, None)[0]) for p in [stereo_pair(row=0.0)] * 4]
    assert found[-1] > 0
    assert front.self_calibration.error.row_rms() < 1.0


def test_an_offset_of_a_pair_counts_where_features_are_tracked_and_is_told_elsewhere(stereo_pair):
    pair, known = stereo_pair(), {"pair.time_offset": 0.01}
    plain = frontend(**{"features.tracking": "never"}).process(pair)
    front = frontend(**known, **{"features.tracking": "never"})
    np.testing.assert_array_equal(front.process(pair).sigma_depth, plain.sigma_depth)
    assert any("pair.time_offset, 10.0 ms, is left out" in text for text in front.report().advice)
    tracked = frontend(**known, **{"features.tracking": "always"})
    assert np.median(tracked.process(pair).sigma_depth) > 2.0 * np.median(plain.sigma_depth)
    assert not any("left out" in text for text in tracked.report().advice)


def test_a_reset_forgets_the_time_between_the_images(stereo_pair):
    front = frontend(**{"features.tracking": "always"})
    front.pair_clock.is_believed = True
    front.reset()
    assert not front.pair_clock.is_believed
