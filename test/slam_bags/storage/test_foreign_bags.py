# SPDX-License-Identifier: Apache-2.0
"""Bags as users have them: other names, other storages, messages that are broken, late or double."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam_bags.reading.readings import StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames, is_rectified, nodes_name, parse_topics, topics_of
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes, typestore
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_bringup.cli import slam
from slam_bringup.processes.interrupt import Interrupt
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import make_transform, so3_exp
from slam_core.messages import rectified_info, transform_message

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
INFOS = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)
FRAMES = {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL}
SECOND = 10**9


def picture(value: int = 0) -> np.ndarray:
    return np.full((12, 16), value, np.uint8)


def write_stereo(path: Path, stamps: list[int], right_delay: int = 0, infos: tuple[CameraInfo, ...] = INFOS) -> Path:
    with BagWriter(path) as bag:
        writer = SensorWriter(bag)
        writer.extrinsics(1, FRAMES)
        for side, frame, info in zip(("left", "right"), (LEFT_FRAME, RIGHT_FRAME), infos, strict=True):
            writer.info(f"stereo/{side}/camera_info", 1, frame, info)
        for stamp in stamps:
            writer.picture("stereo/left/image_raw", stamp, LEFT_FRAME, picture(1))
            writer.picture("stereo/right/image_raw", stamp + right_delay, RIGHT_FRAME, picture(2))
    return path


def renamed(source: Path, target: Path, replace: dict[str, str]) -> Path:
    with BagReader(source) as old, BagWriter(target) as new:
        types = {name: info.type_name for name, info in old.topics.items()}
        for topic, stamp, data in old.raw():
            name = topic
            for before, after in replace.items():
                name = name.replace(before, after)
            new.write_raw(name, types[topic], data, stamp)
    return target


def stamps_of(path: Path, names: BagNames | None = None) -> list[int]:
    with SensorBag(path, names) as bag:
        return [r.stamp_ns for r in bag.readings() if isinstance(r, StereoReading)]


def test_topics_may_have_any_name(tmp_path: Path) -> None:
    bag = write_stereo(tmp_path / "a.mcap", [SECOND, 2 * SECOND])
    new = renamed(bag, tmp_path / "b.mcap", {"/stereo/left": "/camera/infra1", "/stereo/right": "/camera/infra2"})
    with pytest.raises(ValueError, match=r"--topic left=.*\n?.*/camera/infra1/image_raw \(sensor_msgs/msg/Image\)"):
        stamps_of(new)
    topics = parse_topics(["left=/camera/infra1/image_raw", "right=camera/infra2/image_raw"])
    assert stamps_of(new, BagNames(topics)) == [SECOND, 2 * SECOND]
    with pytest.raises(ValueError, match="the bag has no topic /camera/infra3/image_raw; it has /camera/infra1"):
        stamps_of(new, BagNames({**topics, "right": "/camera/infra3/image_raw"}))
    for wrong in ("left", "middle=/a", "left="):
        with pytest.raises(ValueError, match="is not ROLE=TOPIC with a role of left, right, range"):
            parse_topics([wrong])


def test_camera_infos_are_looked_for_beside_the_images() -> None:
    known = {"/l/image_rect_raw/compressed", "/r/image", "/r/camera_info", "/tof/depth/image_raw", "/tof/camera_info"}
    found = topics_of("", known, {"left": "/l/image_rect_raw/compressed", "right": "/r/image"})
    assert found["left_info"] == "/l/camera_info"
    assert found["right_info"] == "/r/camera_info"
    assert found["tof_info"] == "/tof/camera_info"
    assert is_rectified("/l/image_rect_raw/compressed")
    assert not is_rectified("/rectory/image_raw")
    assert nodes_name("one", "left", "/x/image_rect_raw", "depth") == "/one/stereo/left/image_rect"
    assert nodes_name("", "right", "/x/image/compressed", "depth") == "/stereo/right/image_raw/compressed"
    assert nodes_name("", "depth", "/x/y", "range") == "/tof/range/image_raw"


def test_rectified_images_are_not_rectified_again(tmp_path: Path) -> None:
    raw = Camera(16, 12, 25.0, 25.0, 7.0, 5.0, "plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0))
    R = so3_exp(np.array([0.02, 0.0, 0.01]))
    infos = tuple(CameraInfo(raw, R, info.P) for info in INFOS)
    bag = write_stereo(tmp_path / "a.mcap", [SECOND], infos=infos)
    rectified = renamed(bag, tmp_path / "b.mcap", {"image_raw": "image_rect"})
    for path, expected in ((bag, False), (rectified, True)):
        with SensorBag(path) as opened:
            left, right = opened.sensors[""].left, opened.sensors[""].right
        assert left is not None
        assert right is not None
        assert (left.is_rectified, right.camera.is_rectified) == (expected, expected)
        assert right.baseline == pytest.approx(0.1)


def test_what_cannot_be_used_is_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    bag = write_stereo(tmp_path / "a.mcap", [k * SECOND for k in range(1, 5)])
    with BagReader(bag) as old, BagWriter(tmp_path / "b.mcap") as new:
        types = {name: info.type_name for name, info in old.topics.items()}
        for number, (topic, stamp, data) in enumerate(old.raw()):
            new.write_raw(topic, types[topic], data[:50] if number == 5 else data, stamp)
            if number in (7, 8):  # a pair comes twice
                new.write_raw(topic, types[topic], data, stamp)
    with SensorBag(tmp_path / "b.mcap") as opened:
        stamps = [r.stamp_ns for r in opened.readings() if isinstance(r, StereoReading)]
        assert stamps == [1 * SECOND, 3 * SECOND, 4 * SECOND]
        assert sum(opened.left_out.values()) == 4
        assert opened.left_out["unusable messages on /stereo/left/image_raw"] == 1
        assert "cannot be decoded" in opened.warnings[0]


def test_time_that_jumps_back_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_stereo(path, [5 * SECOND, 6 * SECOND])
    with BagReader(path) as old, BagWriter(tmp_path / "b.mcap") as new:
        types = {name: info.type_name for name, info in old.topics.items()}
        for again in range(2):  # the same header stamps once more, recorded later
            for topic, stamp, data in old.raw():
                new.write_raw(topic, types[topic], data, stamp + 100 * again * SECOND)
    with SensorBag(tmp_path / "b.mcap") as opened:
        assert len([r for r in opened.readings() if isinstance(r, StereoReading)]) == 2
        assert opened.left_out == {
            f"{fault} on /stereo/{side}/image_raw": 1
            for fault in ("stamps off their stream", "duplicate stamps")
            for side in ("left", "right")
        }


def test_stamps_of_a_pair_may_differ_a_little(tmp_path: Path) -> None:
    stamps = [k * SECOND // 10 for k in range(1, 6)]
    assert stamps_of(write_stereo(tmp_path / "a.mcap", stamps, right_delay=900_000)) == stamps
    late = write_stereo(tmp_path / "b.mcap", stamps, right_delay=30_000_000)
    assert stamps_of(late) == []
    result = CliRunner().invoke(slam, ["run", str(late), "-o", str(tmp_path / "out")])
    assert "not one frame of b.mcap could be used: 10 x images without a partner" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_poses_are_those_of_base_link_or_of_the_root_above_the_camera(tmp_path: Path) -> None:
    bag = write_stereo(tmp_path / "a.mcap", [SECOND])
    other = tmp_path / "b.mcap"
    T = make_transform(so3_exp(np.array([0.1, 0.0, 0.0])), np.array([1.0, 0.0, 0.0]))
    with BagReader(bag) as old, BagWriter(other) as new:
        new.write(
            "/tf_static",
            BagTypes().TFMessage(transforms=[transform_message(BagTypes(), 1, "camera_link", LEFT_FRAME, T)]),
            1,
        )
        for topic, stamp, message in old.messages():
            if topic != "/tf_static":
                new.write(topic, message, stamp)
    with SensorBag(other) as opened:
        assert opened.sensors[""].base_frame == "camera_link"
        np.testing.assert_allclose(opened.sensors[""].transform("base", "left"), T, atol=1e-12)
        assert "poses are those of camera_link" in opened.warnings[0]
    with SensorBag(other, BagNames(base_frame=LEFT_FRAME)) as opened:
        np.testing.assert_array_equal(opened.sensors[""].transform("base", "left"), np.eye(4))
    bare = renamed(bag, tmp_path / "c.mcap", {"/tf_static": "/unheard"})
    with pytest.raises(ValueError, match=f"--base-frame {LEFT_FRAME}"):
        stamps_of(bare)
    with SensorBag(bare, BagNames(base_frame=LEFT_FRAME)) as opened:
        assert [r.stamp_ns for r in opened.readings() if isinstance(r, StereoReading)] == [SECOND]
        assert opened.sensors[""].is_mounted("left")
        assert not opened.sensors[""].is_mounted("tof")


def test_bags_of_ros_1_are_read(tmp_path: Path) -> None:
    new = write_stereo(tmp_path / "a.mcap", [SECOND, 2 * SECOND])
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    ros1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with BagReader(new) as source, Ros1Writer(tmp_path / "old.bag") as target:
        connections = {
            topic: target.add_connection(topic, info.type_name, typestore=ros1) for topic, info in source.topics.items()
        }
        types = {name: info.type_name for name, info in source.topics.items()}
        for topic, stamp, data in source.raw():
            target.write(connections[topic], stamp, bytes(typestore().cdr_to_ros1(data, types[topic])))
    assert stamps_of(tmp_path / "old.bag") == [SECOND, 2 * SECOND]
    with SensorBag(tmp_path / "old.bag") as opened:
        assert opened.sensors[""].right is not None
        assert opened.sensors[""].right.baseline == pytest.approx(0.1)
    (tmp_path / "cut.bag").write_bytes((tmp_path / "old.bag").read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"cut\.bag cannot be read as a bag"):
        stamps_of(tmp_path / "cut.bag")


def test_the_first_signal_is_a_wish_and_the_second_an_order() -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interrupt() as interrupt:
        assert not interrupt.asked
        signal.raise_signal(signal.SIGINT)
        assert interrupt.asked
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_folder_that_cannot_be_written_is_refused_before_the_run(tmp_path: Path) -> None:
    bag = write_stereo(tmp_path / "a.mcap", [SECOND])
    result = CliRunner().invoke(slam, ["run", str(bag), "-o", str(bag / "out")])
    assert "cannot write to" in str(result.exception)


def test_a_folder_of_ros_2_may_have_the_ending_of_ros_1(tmp_path: Path) -> None:
    assert stamps_of(write_stereo(tmp_path / "my.bag", [SECOND])) == [SECOND]
