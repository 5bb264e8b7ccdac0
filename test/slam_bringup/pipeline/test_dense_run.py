# SPDX-License-Identifier: Apache-2.0
"""The dense model of a bag takes the colours of the colour camera, at the images that they belong to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slam_bags.datasets.rgbd import RgbdDataset
from slam_bags.reading.readings import ColourReading, DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_bringup.pipeline.configuration import load_system_config
from slam_bringup.pipeline.dense_run import dense_model
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import make_transform
from slam_core.messages import compressed_image_message, header_message, image_message
from slam_core.types import PoseEstimate
from stereo_frontend.stage import StereoStage
from stereo_frontend.stereo.rectification_error import RectificationError

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
ORANGE = (240, 130, 20)


def wall_of_colour(root: Path) -> Path:
    """Six frames of an orange wall 2 m ahead, 0.25 m aside each; the upper half of the picture is dark."""
    picture = np.empty((96, 128, 3), np.uint8)
    picture[:], picture[:48] = ORANGE, (10, 10, 10)
    for i in range(6):
        for name, image in (("color", picture[..., ::-1]), ("depth", np.full((96, 128), 2000, np.uint16))):
            (root / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(root / name / f"{i}.png"), image)
    rows = [[0.25 * i, 0, 0, 0, 0, 0, 1] for i in range(6)]
    np.savetxt(root / "pose.txt", np.array(rows, dtype=float))
    (root / "K.txt").write_text("120 0 63.5\n0 120 47.5\n0 0 1\n")
    return root


def bag_of(root: Path, path: Path) -> Path:
    with BagWriter(path) as bag:
        list(RgbdDataset(root, root / "K.txt").write(SensorWriter(bag)))
    return path


def stereo_bag_of_colour(path: Path, encoding: str) -> Path:
    """Six frames of a textured orange wall 2 m before a colour stereo camera of 0.1 m, 0.25 m aside each."""
    texture = np.random.default_rng(3).uniform(0.2, 1.0, (120, 256)).astype(np.float32)
    wall = (cv2.resize(texture, (512, 240))[..., None] * ORANGE).astype(np.uint8)
    P = np.array([[240.0, 0, 159.5, 0], [0, 240.0, 119.5, 0], [0, 0, 1, 0]])
    infos = [CameraInfo(Camera(320, 240, 240.0, 240.0, 159.5, 119.5), P=P.copy()) for _ in range(2)]
    infos[1].P[0, 3] = -240.0 * 0.1
    types = BagTypes()
    with BagWriter(path) as bag:
        writer = SensorWriter(bag)
        writer.extrinsics(10**9, {LEFT_FRAME: T_BASE_OPTICAL})
        for i in range(6):
            stamp = 10**9 + i * 10**8
            writer.ground_truth(stamp, make_transform(np.eye(3), np.array([0.0, -0.25 * i, 0.0])))
            for side, frame, shift, info in zip(
                ("left", "right"), (LEFT_FRAME, RIGHT_FRAME), (0, 12), infos, strict=True
            ):
                image = np.ascontiguousarray(wall[:, 30 * i + shift : 30 * i + shift + 320])
                header = header_message(types, stamp, frame)
                topic = f"/stereo/{side}/image_raw"
                if encoding == "jpeg":
                    jpeg = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 98))[1].tobytes()
                    bag.write(f"{topic}/compressed", compressed_image_message(types, header, jpeg, "jpeg"), stamp)
                else:
                    bag.write(topic, image_message(types, header, _encoded(image, encoding), encoding), stamp)
                writer.info(f"stereo/{side}/camera_info", stamp, frame, info)
    return path


def _encoded(image: np.ndarray, encoding: str) -> np.ndarray:
    if encoding == "bayer_rggb8":
        mosaic = image[..., 1].copy()
        mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 0], image[1::2, 1::2, 2]
        return mosaic
    return {"rgb8": image, "bgr8": image[..., ::-1], "mono8": cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)}[encoding]


def surface_colours(bag: SensorBag) -> tuple[np.ndarray, np.ndarray]:
    """Heights and colours of the model on the true poses."""
    truth = bag.ground_truth("")
    poses = [PoseEstimate(int(s), T, np.eye(6)) for s, T in zip(truth.stamps_ns, truth.poses, strict=True)]
    model = dense_model(bag, load_system_config(None), {"": type(truth).from_estimates(poses)})
    surface = model.surface()
    assert len(surface) > 500
    return surface.points[:, 2], surface.colours.astype(int)


def test_a_converted_data_set_keeps_its_colours_and_the_surface_has_them(tmp_path):
    with SensorBag(bag_of(wall_of_colour(tmp_path / "set"), tmp_path / "bag")) as bag:
        pictures = [r for r in bag.readings(colours=True) if isinstance(r, ColourReading)]
        assert len(pictures) == 6
        assert tuple(pictures[0].image[90, 5]) == ORANGE
        assert not any(isinstance(r, ColourReading) for r in bag.readings())
        height, colours = surface_colours(bag)
    assert np.abs(colours[height < -0.1] - ORANGE).max() <= 2
    assert colours[height > 0.1].max() <= 12


def test_a_colour_image_alone_is_also_the_picture_that_features_come_from(tmp_path):
    source = bag_of(wall_of_colour(tmp_path / "set"), tmp_path / "whole")
    with BagReader(source) as reader, BagWriter(tmp_path / "bag") as bag:
        for topic, stamp, data in reader.raw():
            if "amplitude" not in topic:
                bag.write_raw(topic.replace("tof/color", "camera/rgb"), reader.topics[topic].type_name, data, stamp)
    with SensorBag(tmp_path / "bag", BagNames({"color": "/camera/rgb/image_raw"})) as bag:
        depth = next(r for r in bag.readings() if isinstance(r, DepthReading))
        assert depth.raw.amplitude is not None
        assert depth.raw.amplitude.shape == (96, 128)
        assert depth.raw.amplitude[90, 5] == cv2.cvtColor(np.uint8([[ORANGE]]), cv2.COLOR_RGB2GRAY)[0, 0]
        _, colours = surface_colours(bag)
    assert np.abs(colours - ORANGE).max(axis=1).min() <= 2


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "bayer_rggb8", "jpeg", "mono8"])
def test_a_stereo_camera_in_colour_colours_the_surface_and_features_see_grey(tmp_path, encoding):
    with SensorBag(stereo_bag_of_colour(tmp_path / "bag", encoding)) as bag:
        pair = next(r.pair for r in bag.readings() if isinstance(r, StereoReading))
        assert pair.left.shape == pair.right.shape == (240, 320)
        _, colours = surface_colours(bag)
    share = colours.mean(axis=0) / colours.mean(axis=0).max()
    np.testing.assert_allclose(share, [1.0, 1.0, 1.0] if encoding == "mono8" else np.array(ORANGE) / 240, atol=0.03)
    assert colours.mean() > 40, "as bright as the wall"


def test_a_bag_that_was_read_before_gives_the_same_model_from_its_key_frames_alone(monkeypatch) -> None:
    unpacked: list[int] = []
    with SensorBag(DEMO) as bag:
        agent = bag.agents[0]
        truth = bag.ground_truth(agent)
        poses = truth.select(np.arange(len(truth) - 3))  # the last images have no pose
        raw = bag.reader.raw
        monkeypatch.setattr(bag.reader, "raw", lambda *a: (unpacked.append(len(m.data)) or m for m in raw(*a)))
        models, heard, passed = [], [], []
        for _ in range(2):
            unpacked.clear()
            models.append(dense_model(bag, load_system_config(None), {agent: poses}, lambda: heard.append(1)))
            passed.append(sum(unpacked))
            heard.clear()
            readings = sum(1 for _ in bag.readings())
        dense_model(bag, load_system_config(None), {agent: poses}, lambda: heard.append(1))
    assert len(heard) == readings
    first, second = models
    assert passed[1] < 0.6 * passed[0]
    one, other = (stage.model for stage in models)
    assert [k.keyframe.stamp_ns for k in one.keyframes] == [k.keyframe.stamp_ns for k in other.keyframes]
    assert len(one.keyframes) > 5
    np.testing.assert_array_equal(one.volume.voxels, other.volume.voxels)
    np.testing.assert_array_equal(first.specific_force(), second.specific_force())


def test_dense_stereo_is_rectified_as_self_calibration_says(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[RectificationError | None] = []
    monkeypatch.setattr(StereoStage, "correct", lambda _, error: used.append(error))
    with SensorBag(DEMO) as bag:
        agent = bag.agents[0]
        error = RectificationError.unknown(bag.sensors[agent].left.rectified)
        truth = bag.ground_truth(agent).select(np.arange(3))
        for corrections in (None, {agent: error}):
            dense_model(bag, load_system_config(None), {agent: truth}, corrections=corrections)
    assert used == [None, error]
