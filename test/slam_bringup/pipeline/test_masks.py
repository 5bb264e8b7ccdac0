# SPDX-License-Identifier: Apache-2.0
"""Masks of a bag, also late ones, reach the features and the dense model of the offline run, and the nodes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_bringup.pipeline.configuration import SystemConfig, load_system_config
from slam_bringup.pipeline.dense_run import dense_model
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_bringup.processes.node_graph import plan_nodes
from slam_core.messages import header_message, image_message, stamp_ns
from slam_core.types import Features

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
LATE_NS = 250_000_000
"""After the images, in the bag: a detector takes its time."""


@pytest.fixture(scope="module")
def masked_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with masks of the left halves of its left pictures."""
    path, types = tmp_path_factory.mktemp("masks") / "bag", BagTypes()
    with BagReader(DEMO) as demo, BagWriter(path) as bag:
        names = {topic for topic in demo.topics if topic.startswith(("/stereo", "/tf_static", "/ground_truth/pose"))}
        width, height = next((m.width, m.height) for _, _, m in demo.messages(["/stereo/left/camera_info"]))
        pixels = np.zeros((height, width), np.uint8)
        pixels[:, : width // 2] = 200
        for topic, recorded_ns, message in demo.messages(names):
            bag.write(topic, message, recorded_ns)
            if topic.startswith("/stereo/left/image"):
                header = header_message(types, stamp_ns(message), "")
                bag.write("/people", image_message(types, header, pixels), recorded_ns + LATE_NS)
    return path


def opened(path: Path) -> SensorBag:
    return SensorBag(path, BagNames({"mask": "/people"}))


def test_features_keep_out_of_the_masks_of_a_bag(masked_bag: Path) -> None:
    with opened(masked_bag) as bag:
        pipeline = SensorPipeline(SystemConfig(), bag.sensors[""], False, StageTimes())
        items = [item for reading in bag.readings() for item in pipeline.add(reading)]
        frames = [pipeline.measure(item).value for item in (*items, *pipeline.finish())]
    features = [frame for frame in frames if isinstance(frame, Features)]
    assert len(features) > 20
    assert all(len(f) > 10 and f.uv[:, 0].min() > f.camera.width / 2 for f in features)


@pytest.mark.parametrize("is_second", [False, True])
def test_the_dense_model_leaves_masked_pixels_out(masked_bag: Path, is_second: bool) -> None:
    config = load_system_config(None)
    config = replace(config, dense_mapper=replace(config.dense_mapper, use_tof=False))
    with opened(masked_bag) as bag:
        if is_second:  # only the key frames are read then
            list(bag.readings())
        truth = bag.ground_truth("")
        assert truth is not None
        model = dense_model(bag, config, {"": truth}).model
    assert len(model.keyframes) > 3
    for placed in model.keyframes:
        depth = placed.keyframe.depth
        assert not depth[:, : depth.shape[1] // 2].any()
    assert sum(placed.keyframe.depth.any() for placed in model.keyframes) > 3


def test_nodes_are_given_the_masks(masked_bag: Path) -> None:
    with opened(masked_bag) as bag:
        graph = plan_nodes(SystemConfig(), bag.sensors, False, "map")
    assert graph.played["/people"] == "/mask"
    (extractor,) = (spec for spec in graph.specs if spec.executable == "feature_extractor")
    assert extractor.parameters["mask.use"] == "always"
