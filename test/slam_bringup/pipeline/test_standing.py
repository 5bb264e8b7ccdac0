# SPDX-License-Identifier: Apache-2.0
"""A rig that stands, in real pixels: one stereo pair again and again with fresh noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ekf_slam_node.results import EkfResult
from ekf_slam_node.stage import FilterStage
from slam_bags.reading.readings import StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.types import ByteArray, Features

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
FRAMES = 20


def noisy(picture: ByteArray, rng: np.random.Generator) -> ByteArray:
    return np.clip(picture + 2.0 * rng.standard_normal(picture.shape), 0, 255).astype(np.uint8)


def test_a_pair_that_repeats_moves_and_maps_nothing() -> None:
    rng, results = np.random.default_rng(0), list[EkfResult]()
    config = choose(load_system_config(None), "stereo", "sjsam", "none", "off")
    with SensorBag(DEMO) as bag:
        sensors = bag.sensors[bag.agents[0]]
        first = next(reading for reading in bag.readings() if isinstance(reading, StereoReading))
    pipeline = SensorPipeline(config, sensors, False, StageTimes())
    stage = FilterStage(config.ekf_slam, sensors.frames, sensors.base_frame)
    for k in range(FRAMES):
        stamp_ns = first.stamp_ns + k * 100_000_000
        pair = replace(
            first.pair, stamp_ns=stamp_ns, left=noisy(first.pair.left, rng), right=noisy(first.pair.right, rng)
        )
        for item in pipeline.add(replace(first, pair=pair)):
            features = pipeline.measure(item).value
            assert isinstance(features, Features)
            stage.add_features(features)
            results += [frame.estimate for frame in stage.ready()]
    places = np.array([result.pose.T[:3, 3] for result in results])
    assert len(results) == FRAMES
    assert np.linalg.norm(places[6:], axis=1).max() < 1e-3
    assert np.ptp(places[8:], axis=0).max() == 0.0
    assert stage.counters.counts["frames_standing"] >= FRAMES - 8
    assert len(stage.finish()) == 1
    assert not any(result.submaps for result in results)
