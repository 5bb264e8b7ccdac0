# SPDX-License-Identifier: Apache-2.0
"""No features where a mask is not zero, whatever the camera; one that is late, missing or wrong holds nothing up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_core.camera import Camera
from slam_core.frame_tree import FrameTree
from slam_core.messages import image_message, mask_from_message
from slam_core.types import ByteArray, DepthImage, Features, Mask
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.masks import MaskingConfig, is_masked, widened
from stereo_frontend.stage import FeatureStage

_STEP_NS = 100_000_000
_RIGHT_HALF = slice(160, None)


def mask_of(shape: tuple[int, int], columns: slice = _RIGHT_HALF) -> ByteArray:
    pixels = np.zeros(shape, np.uint8)
    pixels[:, columns] = 3
    return pixels


def run(stage: FeatureStage) -> list[Features]:
    return [stage.measure(frame) for frame in stage.extracted()]


@pytest.fixture
def stage() -> FeatureStage:
    return FeatureStage(FrontendConfig(), FrameTree())


def test_pixels_in_the_areas_and_beside_them_are_masked() -> None:
    mask = np.zeros((5, 6), np.uint8)
    mask[2, 3] = 7
    uv = np.array([[3.4, 2.4], [3.0, 3.0], [-4.0, 2.0], [np.nan, 2.0], [9.0, 9.0]])
    assert is_masked(mask, uv).tolist() == [True, False, False, False, False]
    assert is_masked(widened(mask, 1), uv).tolist() == [True, True, False, False, False]
    assert not is_masked(None, uv).any()


def test_neither_new_features_nor_tracks_lie_in_masks(stereo_pair, stage: FeatureStage) -> None:
    pair = stereo_pair()
    for k in range(4):  # the first frames have no mask: tracks begin everywhere
        if k >= 2:
            stage.add_mask(Mask(k * _STEP_NS, mask_of(pair.left.shape)))
        stage.add_images(replace(pair, stamp_ns=k * _STEP_NS))
    frames = run(stage)
    assert [(f.uv[:, 0] >= 160).sum() > 20 for f in frames] == [True, True, False, False]
    for features in frames[2:]:
        assert features.uv[:, 0].max() < 160 - MaskingConfig().margin + 0.5
        assert len(features) > 30
    assert stage.counters["frames_masked"] == 2
    assert stage.counters["keypoints_masked"] > 20


def test_features_of_a_depth_camera_keep_out_of_masks(rng: np.random.Generator, stereo_pair) -> None:
    stage = FeatureStage(FrontendConfig(mode="tof"), FrameTree())
    amplitude = stereo_pair().left.astype(np.float32)
    shape = amplitude.shape
    depth = DepthImage(0, np.full(shape, 2.0, np.float32), np.full(shape, 0.01, np.float32),
                       Camera(shape[1], shape[0], 200.0, 200.0, 160.0, 120.0), amplitude)  # fmt: skip
    stage.add_mask(Mask(0, mask_of(shape)))
    stage.add_depth(depth)
    (features,) = run(stage)
    assert len(features) > 30
    assert features.uv[:, 0].max() < 160


def test_a_frame_waits_for_its_mask_once_there_are_any(stereo_pair, stage: FeatureStage) -> None:
    pair = stereo_pair()
    stage.add_images(pair)
    assert len(run(stage)) == 1  # nobody has heard of masks yet
    stage.add_mask(Mask(pair.stamp_ns, mask_of(pair.left.shape)))
    later = replace(pair, stamp_ns=pair.stamp_ns + 3 * _STEP_NS)
    stage.add_images(later)
    assert run(stage) == []
    assert stage.oldest_waiting_ns == later.stamp_ns
    stage.add_mask(Mask(later.stamp_ns, mask_of(pair.left.shape)))
    (features,) = run(stage)
    assert features.uv[:, 0].max() < 160


def test_features_go_on_without_masks_that_never_come(stereo_pair) -> None:
    pair = stereo_pair()
    stage = FeatureStage(FrontendConfig(mask=MaskingConfig(use="always", patience=2)), FrameTree())
    numbers = []
    for k in range(5):
        stage.add_images(replace(pair, stamp_ns=k * _STEP_NS))
        numbers.append(len(run(stage)))
    assert numbers == [0, 0, 3, 1, 1]
    assert stage.diagnostic == "no mask so far"


def test_a_frame_whose_mask_is_missing_is_counted_and_takes_a_near_one(stereo_pair, stage: FeatureStage) -> None:
    pair, shape = stereo_pair(), (240, 320)
    for k in (0, 4, 8):
        stage.add_mask(Mask(k * _STEP_NS, mask_of(shape)))
    for k in (0, 1, 2, 4):
        stage.add_images(replace(pair, stamp_ns=k * _STEP_NS))
    assert len(run(stage)) == 4
    assert stage.counters["frames_masked"] == 3  # that of 0.1 s takes the one of 0.0 s
    assert stage.counters["frames_without_mask"] == 1


def test_a_mask_of_another_size_is_counted_and_said(stereo_pair, stage: FeatureStage) -> None:
    pair = stereo_pair()
    stage.add_mask(Mask(pair.stamp_ns, mask_of((480, 640))))
    stage.add_images(pair)
    (features,) = run(stage)
    assert (features.uv[:, 0] > 160).any()
    assert stage.counters["masks_of_another_size"] == 1
    assert "masks are 640 x 480 px, the rectified images 320 x 240 px" in stage.diagnostic


def test_masks_can_be_left_alone(stereo_pair) -> None:
    pair = stereo_pair()
    stage = FeatureStage(FrontendConfig(mask=MaskingConfig(use="never")), FrameTree())
    stage.add_mask(Mask(pair.stamp_ns, mask_of(pair.left.shape)))
    stage.add_images(pair)
    (features,) = run(stage)
    assert (features.uv[:, 0] > 160).any()


def test_a_mask_has_eight_bits() -> None:
    types, pixels = BagTypes(), mask_of((240, 320))
    np.testing.assert_array_equal(mask_from_message(image_message(types, types.Header(), pixels)).pixels, pixels)
    with pytest.raises(ValueError, match="a mask is mono8 or 8UC1"):
        mask_from_message(image_message(types, types.Header(), pixels.astype(np.uint16)))
