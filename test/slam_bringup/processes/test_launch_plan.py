# SPDX-License-Identifier: Apache-2.0
"""What the launch file starts, without ROS's launch: the bag's own topics and frames, and every parameter."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam_bringup.processes.launch_plan import plan_launch

DEMO = (Path(__file__).resolve().parents[3] / "bags" / "demo").resolve()


def parameters(**values: str) -> dict[str, dict[str, object]]:
    return {spec.command.full_name: spec.parameters for spec in plan_launch(values).nodes}


def test_a_bag_brings_its_topics_frames_and_player() -> None:
    found = parameters(bag=str(DEMO), mode="fuse", odometry="ndt", use_sim_time="true")
    assert found["/stereo_driver"]["compressed"] is True
    assert found["/tof_driver"]["pictures"] == "amplitude"
    assert found["/bag_player"]["bag"] == str(DEMO)
    assert "/tof/range/image_raw" in found["/bag_player"]["topics"]
    assert set(found["/bag_player"]["nodes"]) == found.keys() - {"/bag_player"}
    assert {"/tof/range/image_raw=1", "/static_transforms=1"} <= set(found["/bag_player"]["subscribers"])
    assert "autosave_period_s" not in found["/sjsam"]
    assert {"/ndt_odometry", "/feature_extractor", "/ekf_slam", "/sjsam"} < found.keys()
    assert all(p["use_sim_time"] is True for p in found.values())


def test_a_rig_may_name_its_topics_frames_and_files() -> None:
    plan = plan_launch(
        {
            "mode": "fuse", "compressed": "true", "pictures": "none", "measurement": "depth", "base_frame": "rig",
            "map_path": "/maps/a", "localize_only": "true", "set": "ekf_slam.submap.max_distance=2.0",
            "topics": "left=/cam/left/image_raw, left_info=/cam/info, depth=/cam/depth/image_raw, tof_info=/d/info",
        }
    )  # fmt: skip
    found = {spec.executable: spec.parameters for spec in plan.nodes}
    assert found["stereo_driver"]["compressed"] is True
    assert (found["tof_driver"]["pictures"], found["tof_driver"]["measurement"]) == ("none", "depth")
    assert found["feature_extractor"]["tof.images"] == "range"
    assert found["ekf_slam"]["base_frame"] == "rig"
    assert found["ekf_slam"]["submap.max_distance"] == 2.0
    assert (found["sjsam"]["map_path"], found["sjsam"]["localize_only"]) == ("/maps/a", True)
    assert set(plan.remappings) == {
        ("/stereo/left/image_raw", "/cam/left/image_raw"),
        ("/stereo/left/camera_info", "/cam/info"),
        ("/tof/depth/image_raw", "/cam/depth/image_raw"),
        ("/tof/camera_info", "/d/info"),
    }
    assert "stereo_driver" not in {s.executable for s in plan_launch({"rectified": "true"}).nodes}


def test_cameras_of_a_rig_whose_images_are_rectified_have_no_driver(tmp_path: Path) -> None:
    lines = [
        f"  {name}: {{left: /{name}/left/{image}, right: /{name}/right/{image}}}"
        for name, image in (("a", "image_rect_raw"), ("b", "image_raw"))
    ]
    (tmp_path / "rig.yaml").write_text("\n".join(["cameras:", *lines]))
    nodes = plan_launch({"rig": str(tmp_path / "rig.yaml")}).nodes
    assert [spec.namespace for spec in nodes if spec.executable == "stereo_driver"] == ["b"]


def test_the_odometry_of_a_rig_has_an_argument_of_its_own() -> None:
    plan = plan_launch({"odometry_topic": "/wheels", "topics": "imu=/imu/data"})
    assert dict(plan.remappings) == {"/odometry": "/wheels", "/imu": "/imu/data"}


def test_one_line_goes_before_the_file(tmp_path: Path) -> None:
    config = tmp_path / "my.yaml"
    config.write_text("/**:\n  ros__parameters: {input.depth: 20}\nstereo_driver: {left_info: a.yaml}\n")
    found = parameters(config=str(config), set="stereo_driver.left_info=b.yaml", agents="one,two")
    assert found["/one/stereo_driver"] == {"left_info": "b.yaml", "input.depth": 20}
    assert found["/two/ekf_slam"]["input.depth"] == 20


def test_what_is_wrong_is_named() -> None:
    for values, message in (
        ({"set": "ekf_slam.submap.max_distanc=2"}, "ekf_slam: unknown parameter 'submap.max_distanc'"),
        ({"set": "stereo_driver.compresed=true"}, "stereo_driver: unknown parameter 'compresed'"),
        ({"topics": "lft=/a"}, "topic 'lft=/a' is not ROLE=TOPIC"),
        ({"agents": "one,two", "topics": "left=/a"}, "topics can be given for one rig"),
    ):
        with pytest.raises(ValueError, match=message):
            plan_launch(values)
