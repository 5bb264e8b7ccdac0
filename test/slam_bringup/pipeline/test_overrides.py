# SPDX-License-Identifier: Apache-2.0
"""One YAML file for all nodes, in ROS's own form or ours: who gets what, and what is refused with file and name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ndt_registration.odometry import OdometryConfig
from ndt_registration.registration import RegistrationConfig
from slam_bringup.pipeline.configuration import SystemConfig, choose, load_system_config, system_config
from slam_bringup.pipeline.node_table import node_named
from slam_bringup.pipeline.overrides import overrides_of, parse_assignments, read_overrides
from slam_bringup.processes.node_graph import live_nodes
from slam_core.config import changed, iterate_parameters

ROS_FORM = """
/**:
  ros__parameters:
    input.depth: 20
    use_sim_time: true
ekf_slam:
  submap: {max_distance: 1.5}
/one/ekf_slam:
  ros__parameters:
    submap.max_distance: 2.0
/*/stereo_driver:
  ros__parameters:
    compressed: true
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return path


@pytest.mark.ros
def test_every_node_gets_what_names_it(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    overrides = read_overrides(written(tmp_path, ROS_FORM))
    config = system_config(overrides)
    assert config.ekf_slam.submap.max_distance == 1.5
    specs = live_nodes(config, ["one", "two"], odometry=False, overrides=overrides)
    found = {spec.command.full_name: spec.parameters for spec in specs}
    assert all(p["input.depth"] == 20 and p["use_sim_time"] is True for p in found.values())
    assert found["/one/ekf_slam"]["submap.max_distance"] == 2.0
    assert found["/two/ekf_slam"]["submap.max_distance"] == 1.5
    assert found["/two/stereo_driver"]["compressed"] is True
    assert "compressed" not in found["/two/feature_extractor"]


@pytest.mark.ros
def test_parameters_of_the_nodes_alone_do_not_disturb_the_offline_run(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    path = written(tmp_path, "stereo_driver: {compressed: true}\nsjsam: {map_path: there, closures.enabled: true}\n")
    with pytest.raises(ValueError, match=r"my.yaml: sjsam: unknown parameter 'closures"):
        load_system_config(path)
    path.write_text("stereo_driver: {compressed: true}\nsjsam: {map_path: there}\n")
    assert load_system_config(path) == load_system_config(None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ekf_slm: {}", r"my.yaml: no node 'ekf_slm' \(did you mean 'ekf_slam'\?\)"),
        ("/one/ekf_slm: {}", "did you mean 'ekf_slam'"),
        ("/**: {ros__parameters: {input.depht: 3}}", "my.yaml: no node has a parameter 'input.depht'"),
        (
            "ekf_slam: {submap: {max_distanc: 1}}",
            "my.yaml: ekf_slam: unknown parameter 'submap.max_distanc'.*'submap.max_distance'",
        ),
        (
            "ekf_slam: {submap: {max_distance: -1}}",
            "my.yaml: ekf_slam: parameter 'submap.max_distance' must be at least",
        ),
        ("ekf_slam: [1]", "my.yaml: the parameters of ekf_slam must be a mapping"),
        ("ekf_slam: {a: 1", "my.yaml: not YAML"),
        ("- 1", "my.yaml must hold one mapping per node"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_system_config(written(tmp_path, text))


def test_the_last_rule_and_the_rule_for_a_node_win() -> None:
    rules = {"ekf_slam": {"a": 1, "b": 1}, "/**": {"a": 0, "c": 0}, "/*/ekf_slam": {"b": 2}}
    overrides = overrides_of(rules, "here")
    assert overrides.of("/one/ekf_slam") == {"a": 1, "b": 2}
    assert overrides.of("/ekf_slam") == {"a": 1, "b": 1}
    assert overrides.of_all == {"a": 0, "c": 0}


def test_parameters_in_one_line() -> None:
    text = "ekf_slam.submap.max_distance=1.5, sjsam.agents=[a, b]; tof_driver.pictures=none"
    assert parse_assignments(text) == {
        "ekf_slam": {"submap.max_distance": 1.5},
        "sjsam": {"agents": ["a", "b"]},
        "tof_driver": {"pictures": "none"},
    }
    with pytest.raises(ValueError, match=r"is not NODE.PARAMETER=VALUE"):
        parse_assignments("max_distance=1.5")


@pytest.mark.parametrize(
    ("odometry", "configured", "method"),
    [("ndt", "ndt", "ndt"), ("ndt", "icp", "ndt"), ("icp", "ndt", "icp_plane"), ("icp", "icp", "icp")],
)
def test_icp_is_point_to_plane_unless_point_to_point_is_configured(odometry, configured, method):
    config = SystemConfig(ndt_odometry=OdometryConfig(registration=RegistrationConfig(method=configured)))
    assert choose(config, "tof", "sjsam", odometry).ndt_odometry.registration.method == method


PAGE = Path(__file__).parents[3] / "docs" / "configuration.md"
BLOCKS = [*re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL), PAGE.with_suffix(".yaml").read_text()]


@pytest.mark.ros
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block[:20].splitlines()[0])
def test_numbers_of_the_page_are_taken_by_the_nodes_that_it_names(tmp_path: Path, block: str) -> None:
    pytest.importorskip("rclpy")
    path = written(tmp_path, block)
    load_system_config(path)
    for node, _ in read_overrides(path).rules:
        values = read_overrides(path).of(f"/{node}")
        config = node_named(node).load_config_class()()
        found = {name: value for name, value, _ in iterate_parameters(changed(config, values))}
        assert {name: found[name] for name in values} == values


def test_the_file_to_copy_holds_defaults_alone() -> None:
    assert load_system_config(PAGE.with_suffix(".yaml")) == load_system_config(None)
