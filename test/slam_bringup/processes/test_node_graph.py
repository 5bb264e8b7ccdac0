# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dense_mapping.dense_stage import cameras_of
from ekf_slam_node.config import ExternalOdometryConfig
from slam_bags.reading.readings import AgentSensors
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.sensor_pipeline import for_camera
from slam_bringup.processes.node_graph import live_nodes, plan_nodes, viewer_nodes
from slam_bringup.processes.start_map import StartMap
from slam_core.frame_tree import FrameTree


def sensors(agent: str = "") -> AgentSensors:
    below = f"/{agent}" if agent else ""
    topics = {
        "left": f"{below}/stereo/left/image_raw/compressed",
        "right": f"{below}/stereo/right/image_raw/compressed",
        "depth": f"{below}/tof/depth/image_raw",
        "amplitude": f"{below}/tof/amplitude/image_raw",
        "tof_info": f"{below}/tof/camera_info",
    }
    return AgentSensors(agent, None, None, None, "depth", FrameTree(), topics=topics)


def executables(mode: str, odometry: str = "none") -> list[str]:
    config = choose(load_system_config(None), mode, "sjsam", odometry)
    return [spec.executable for spec in live_nodes(config, [""], odometry=odometry != "none")]


def test_every_mode_starts_what_it_needs() -> None:
    assert executables("stereo") == ["stereo_driver", "feature_extractor", "ekf_slam", "sjsam"]
    assert executables("tof") == ["tof_driver", "feature_extractor", "ekf_slam", "sjsam"]
    assert executables("fuse", "ndt") == [
        "stereo_driver", "tof_driver", "ndt_odometry", "feature_extractor", "ekf_slam", "sjsam"
    ]  # fmt: skip


def test_nodes_begin_with_the_map_of_a_run_and_a_session_of_their_own() -> None:
    config, start = choose(load_system_config(None), "fuse", "sjsam", "none"), StartMap(Path("/old/map"), True, 6, 3)
    graph = plan_nodes(config, {"one": sensors("one")}, False, "/out/map", start_map=start)
    found = {spec.executable: spec.parameters for spec in graph.specs}
    assert found["sjsam"]["initial_map"] == "/old/map"
    assert found["sjsam"]["map_path"] == "/out/map", "the old folder is only read"
    assert found["sjsam"]["localize_only"] is True
    assert found["ekf_slam"]["session"] == 3


def test_parameters_follow_from_the_choice_and_the_bag() -> None:
    config = choose(load_system_config(None), "fuse", "sjsam", "icp")
    graph = plan_nodes(config, {"one": sensors("one")}, True, "/out/map")
    arguments = {c.executable: " ".join(c.arguments) for c in graph.commands}
    assert "compressed:=true" in arguments["stereo_driver"]
    assert 'measurement:="depth"' in arguments["tof_driver"]
    assert 'pictures:="amplitude"' in arguments["tof_driver"]
    assert 'mode:="fuse"' in arguments["feature_extractor"]
    assert 'wait_for:=["motion"]' in arguments["ekf_slam"]
    assert 'registration.method:="icp_plane"' in arguments["ndt_odometry"]
    assert 'agents:=["one"]' in arguments["sjsam"]
    assert graph.filters == ("/one/ekf_slam",)
    assert graph.finishers == ("/one/ndt_odometry", "/one/feature_extractor", "/one/ekf_slam")
    assert set(graph.pace) == {
        "/one/ekf_slam=/one/stereo/left/image_raw/compressed",
        "/one/ndt_odometry=/one/tof/depth/image_raw",
    }
    assert "/one/tof/camera_info" in graph.played.values()


@pytest.mark.parametrize("mode", ["tof", "fuse"])
def test_nodes_take_the_image_that_the_bag_has(mode: str) -> None:
    config = choose(load_system_config(None), mode, "sjsam", "none")
    for roles, driver, features in (
        (("amplitude", "intensity"), "both", "amplitude"),
        (("intensity",), "intensity", "intensity"),
        ((), "none", "range"),
    ):
        bag = sensors()
        bag.topics.pop("amplitude", None)
        bag.topics.update({role: f"/tof/{role}/image_raw" for role in roles})
        graph = plan_nodes(config, {"": bag}, False, "map")
        arguments = {c.executable: " ".join(c.arguments) for c in graph.commands}
        assert f'pictures:="{driver}"' in arguments["tof_driver"]
        assert f'tof.images:="{features}"' in arguments["feature_extractor"]


def test_frames_wait_for_the_imu_of_a_bag_that_has_one() -> None:
    with_imu = sensors()
    with_imu.topics["imu"] = "/imu"
    graph = plan_nodes(choose(load_system_config(None), "fuse", "sjsam", "ndt"), {"": with_imu}, True, "map")
    arguments = {c.executable: " ".join(c.arguments) for c in graph.commands}
    assert 'wait_for:=["motion", "imu"]' in arguments["ekf_slam"]


def test_frames_wait_for_the_odometry_of_a_bag_unless_it_is_off() -> None:
    driven = sensors()
    driven.topics["odometry"] = "/base_controller/odom"
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    graph = plan_nodes(config, {"": driven}, False, "map")
    assert graph.played["/base_controller/odom"] == "/odometry"
    assert next(s for s in graph.specs if s.executable == "ekf_slam").parameters["wait_for"] == ("odometry",)
    filters = replace(config.ekf_slam, odometry=ExternalOdometryConfig(use="off"))
    off = plan_nodes(replace(config, ekf_slam=filters), {"": driven}, False, "map")
    assert "wait_for" not in next(s for s in off.specs if s.executable == "ekf_slam").parameters


def test_the_frames_of_an_agent_are_those_of_its_bag_or_lie_below_its_name() -> None:
    config = choose(load_system_config(None), "fuse", "sjsam", "ndt")
    live = {s.executable: s.parameters for s in live_nodes(config, ["one"], odometry=True)}
    assert live["ekf_slam"]["base_frame"] == live["ndt_odometry"]["base_frame"] == "one/base_link"
    assert live["ndt_odometry"]["odom_frame"] == "one/odom"
    graph = plan_nodes(config, {"one": sensors("one")}, True, "map")  # this bag's frames have no prefix
    arguments = {c.executable: " ".join(c.arguments) for c in graph.commands}
    assert 'base_frame:="base_link"' in arguments["ekf_slam"]


def test_the_stereo_mode_leaves_the_depth_camera_alone() -> None:
    graph = plan_nodes(choose(load_system_config(None), "stereo", "sjsam", "none"), {"": sensors()}, False, "map")
    assert not [topic for topic in graph.played.values() if "tof" in topic]


def of_cameras(rig: str = "", **left: str) -> dict[str, AgentSensors]:
    """Stereo cameras of a rig by namespace, with the name of the left images of each."""
    found = {}
    for name, image in left.items():
        place = f"{rig}/{name}".lstrip("/")
        topics = {side: f"/{place}/stereo/{side}/{image}" for side in ("left", "right")}
        found[place] = AgentSensors(place, None, None, None, "depth", FrameTree(), topics=topics, rig=rig, camera=name)
    return found


def test_each_camera_has_a_driver_if_its_own_images_are_raw() -> None:
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    for images in (("image_rect", "image_raw"), ("image_raw", "image_rect")):
        cameras = of_cameras(**dict(zip(("back", "front"), images, strict=True)))
        specs = plan_nodes(config, cameras, False, "map").specs
        drivers = [spec.namespace for spec in specs if spec.executable == "stereo_driver"]
        assert drivers == [name for name, own in cameras.items() if own.topics["left"].endswith("raw")]


def test_the_pressure_of_a_rig_is_heard_at_the_rig() -> None:
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    cameras = of_cameras(back="image_raw", front="image_raw")
    cameras["back"].topics["pressure"] = "/front/pressure"
    assert plan_nodes(config, cameras, False, "map").played["/front/pressure"] == "/pressure"


def test_the_dense_model_hears_the_cameras_that_each_agent_has() -> None:
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    both = {"back": "image_raw", "front": "image_raw"}

    def heard(cameras: dict[str, AgentSensors]) -> dict[str, list[str]]:
        model = viewer_nodes(config, cameras, 8000)[0].parameters
        return {agent: cameras_of(agent, model.get("cameras", ())) for agent in model.get("agents", ("",))}

    assert heard(of_cameras(**both)) == {"": ["back", "front"]}
    assert heard(of_cameras("a", **both) | of_cameras("c", **both)) == {
        "a": ["a/back", "a/front"], "c": ["c/back", "c/front"]
    }  # fmt: skip
    assert heard(of_cameras("a", **both) | {"c": sensors("c")}) == {"a": ["a/back", "a/front"], "c": ["c"]}
    assert heard({"": sensors()}) == {"": [""]}


def test_every_frame_of_one_of_several_cameras_maps() -> None:
    """One camera's frame may map at the moment at which another's would tell the pose alone."""
    config, pair = choose(load_system_config(None), "stereo", "sjsam", "none"), {"left": "a", "right": "b"}
    for cameras, expected in (({}, {None}), ({"": {"front": pair, "back": pair}}, {0.0})):
        specs = live_nodes(config, [""], odometry=False, cameras=cameras)
        found = [spec.parameters for spec in specs if spec.executable == "feature_extractor"]
        assert {parameters.get("features.mapping_interval") for parameters in found} == expected
    rig = replace(sensors(), camera="front")
    assert for_camera(config, rig).feature_extractor.features.mapping_interval == 0.0
