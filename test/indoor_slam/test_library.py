# SPDX-License-Identifier: Apache-2.0
"""The library gives what ``slam run`` gives, the README's lines run, and what is wrong is said."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from demo_parts import cut
from indoor_slam import Camera, CameraInfo, DepthSlam, GlobalMap, StereoSlam, register
from mapping import mapped
from slam_bags.reading.readings import DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 20


@pytest.fixture(scope="module")
def bag_of_demo(tmp_path_factory):
    """The first part of the demo, of several submaps."""
    return cut(tmp_path_factory.mktemp("demo") / "part.mcap", 0.0, 0.5)


@pytest.fixture(scope="module")
def demo(bag_of_demo):
    """Sensors and the readings of that part."""
    with SensorBag(bag_of_demo) as bag:
        sensors = bag.sensors[""]
        readings = list(bag.readings())
    return sensors, readings


def pairs_of(readings):
    return [(r.stamp_ns, r.pair.left, r.pair.right) for r in readings if isinstance(r, StereoReading)]


def test_the_library_maps_as_slam_run_does(demo, bag_of_demo):
    sensors, readings = demo
    result = mapped(bag_of_demo, imu="off")
    assert result.submaps > 1
    with StereoSlam(sensors.left, sensors.right, T_base_left=sensors.transform("base", "left")) as slam:
        frames = [frame for pair in pairs_of(readings) for frame in slam.add_pair(*pair)]
        joined = slam.finish()
    online = result.agents[0]
    np.testing.assert_array_equal([f.stamp_ns for f in frames], online.filtered.stamps_ns)
    np.testing.assert_array_equal([f.pose.T for f in frames], online.filtered.poses)
    np.testing.assert_array_equal([p.T for p in joined.trajectory()[""]], online.trajectory.poses)


def test_the_lines_of_the_readme_run(demo, tmp_path, monkeypatch, capsys):
    sensors, readings = demo
    lines = re.search(
        r"```python\n(from indoor_slam .*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    assert lines is not None
    monkeypatch.chdir(tmp_path)
    names = {"left_info": sensors.left, "right_info": sensors.right, "pairs": pairs_of(readings)[:FRAMES]}
    exec(compile(lines[1], "README.md", "exec"), names)
    assert "landmarks" in capsys.readouterr().out
    assert len(names["path"]) == FRAMES
    for pose in names["path"][1:]:
        assert np.linalg.eigvalsh(pose.covariance).min() > 0.0
    assert len(GlobalMap.load(tmp_path / "map").trajectory("")) == FRAMES


def test_a_depth_camera_with_scan_odometry_maps_as_slam_run_does(demo, bag_of_demo):
    sensors, readings = demo
    result = mapped(bag_of_demo, "tof", "ndt", "off")
    assert result.submaps > 1
    raw = [r.raw for r in readings if isinstance(r, DepthReading)]
    mounting = sensors.transform("base", "tof")
    with DepthSlam(sensors.tof, measurement=sensors.measurement, odometry="ndt", T_base_camera=mounting) as slam:
        for image in raw:
            slam.add_image(image.stamp_ns, image.image, image.amplitude)
        joined = slam.finish()
    np.testing.assert_array_equal([p.T for p in joined.trajectory()[""]], result.agents[0].trajectory.poses)


def test_frames_wait_for_the_imu(demo):
    sensors, readings = demo
    (first, *images), (second, *others) = pairs_of(readings)[:2]
    with StereoSlam(sensors.left, sensors.right, T_base_imu=np.eye(4)) as slam:
        assert slam.add_pair(first, *images) == slam.add_pair(second, *others) == []
        stamps = range(first - 10**7, second + 2 * 10**7, 10**7)
        found = [f for stamp in stamps for f in slam.add_imu(stamp, np.zeros(3), np.array([0.0, 0.0, 9.81]))]
    assert [f.stamp_ns for f in found] == [first, second]


def test_a_submap_that_cannot_be_joined_is_named(demo, monkeypatch, caplog):
    sensors, readings = demo

    def fail(*_):
        raise RuntimeError("no room")

    monkeypatch.setattr("sjsam_node.global_map.GlobalMap.add", fail)
    with StereoSlam(sensors.left, sensors.right) as slam:
        for pair in pairs_of(readings)[:FRAMES]:
            slam.add_pair(*pair)
        assert len(slam.finish()) == 0
    assert "no room" in caplog.text


def test_what_is_wrong_is_said(demo):
    sensors, readings = demo
    stamp, left, right = pairs_of(readings)[0]
    with StereoSlam(sensors.left, sensors.right) as slam:
        slam.add_pair(stamp, left, right)
        with pytest.raises(ValueError, match="not later"):
            slam.add_pair(stamp, left, right)
        with pytest.raises(ValueError, match="no IMU"):
            slam.add_imu(stamp, np.zeros(3), np.zeros(3))
        with pytest.raises(ValueError, match="image"):
            slam.add_pair(stamp + 1, left[:10], right[:10])
    with pytest.raises(ValueError, match="unknown parameter"):
        StereoSlam(sensors.left, sensors.right, parameters={"ekf_slam": {"submap.max_distanc": 1.0}})
    with pytest.raises(ValueError, match="measurement"):
        DepthSlam(CameraInfo(Camera(4, 4, 2.0, 2.0, 2.0, 2.0)), measurement="height")


def test_clouds_are_registered(rng):
    walls = rng.uniform(0.0, 2.0, (3000, 3)) * np.repeat(1.0 - np.eye(3), 1000, axis=0)
    moved = walls + np.array([0.05, -0.03, 0.02])
    assert np.abs(register(walls, moved).T_target_source[:3, 3] - [0.05, -0.03, 0.02]).max() < 0.01


def test_ros_is_not_loaded():
    program = "import sys, indoor_slam; sys.exit('rclpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
