# SPDX-License-Identifier: Apache-2.0
"""The nodes that ``slam live`` starts: topics, frames, calibration and a map to begin with; nothing is started."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from click.testing import CliRunner

from calibration_folder import write_calibrations
from slam_bringup.cli import slam
from slam_bringup.processes.processes import NodeCommand

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments by executable, and ``rest``: what every node is given; filled by the command."""
    found: dict[str, Any] = {}

    def run_composed(commands: Sequence[NodeCommand], arguments: Sequence[str] = ()) -> None:
        found.update({c.executable: " ".join(c.arguments) for c in commands}, rest=list(arguments))

    module = ModuleType("composed_node")
    module.run_composed = run_composed  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "slam_bringup.processes.composed_node", module)
    return found


def test_topics_frames_and_a_map_reach_the_nodes(started: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    words = ["live", "--topic", "left=/cam/left/image_raw", "--base-frame", "rig", "--map", str(tmp_path)]
    result = CliRunner().invoke(slam, [*words, "--localize-only"])
    assert result.exit_code == 0, result.output
    assert started["rest"] == ["--ros-args", "-r", "/stereo/left/image_raw:=/cam/left/image_raw"]
    assert 'base_frame:="rig"' in started["ekf_slam"]
    assert f'initial_map:="{tmp_path}/map"' in started["sjsam"]
    assert "localize_only:=true" in started["sjsam"]
    assert "map_path" not in started["sjsam"], "the old map is only read"


def test_a_camera_needs_its_calibration(started: dict[str, Any], tmp_path: Path) -> None:
    refused = CliRunner().invoke(slam, ["live", "0"])
    assert refused.exit_code != 0
    assert "--calibration" in refused.output + str(refused.exception)
    folder = write_calibrations(DEMO, tmp_path)[0]
    result = CliRunner().invoke(slam, ["live", "0", "--calibration", str(folder)])
    assert result.exit_code == 0, result.output
    assert 'source:="camera"' in started["stereo_driver"]
    assert "left_info:=" in started["stereo_driver"]


def test_what_to_map_is_asked_for(started: dict[str, Any]) -> None:
    for words in ([], ["0", "--topics"], ["0", "--topic", "left=/l"]):
        assert CliRunner().invoke(slam, ["live", *words]).exit_code != 0
    refused = CliRunner().invoke(slam, ["live", "--topics", "--localize-only"])
    assert "--map" in refused.output + str(refused.exception)
    assert not started


def test_a_rig_with_a_name_speaks_to_a_command_post(started: dict[str, Any]) -> None:
    words = ["live", "--topics", "--post", "tcp/10.0.0.1:7447"]
    for names in ([], ["--agents", "anna,bert"]):
        refused = CliRunner().invoke(slam, [*words, *names])
        assert "--agents NAME" in refused.output + str(refused.exception)
    assert CliRunner().invoke(slam, [*words, "--agents", "anna"]).exit_code == 0
    assert 'connect:=["tcp/10.0.0.1:7447"]' in started["radio_link"]
    assert 'agents:=["anna"]' in started["radio_link"]
    assert 'base_frame:="anna/base_link"' in started["radio_link"]
    assert "__ns:=/anna" in started["radio_link"]


def test_agents_without_a_post_have_a_map_of_their_own_together(started: dict[str, Any]) -> None:
    words = ["live", "--topics", "--peer", "bert=tcp/10.0.0.2:7448", "--peer", "cleo"]
    refused = CliRunner().invoke(slam, words)
    assert "--agents NAME" in refused.output + str(refused.exception)
    for wrong in ("bert", "=tcp/10.0.0.3:7448", "dora="):
        refused = CliRunner().invoke(slam, [*words, "--agents", "anna", "--peer", wrong])
        assert "NAME=ADDRESS" in refused.output + str(refused.exception)
    assert not started
    assert CliRunner().invoke(slam, [*words, "--agents", "anna"]).exit_code == 0
    link, joined = started["radio_link"], started["sjsam"]
    for part in ('role:="peer"', 'agents:=["anna", "bert", "cleo"]', 'connect:=["tcp/10.0.0.2:7448"]',
                 "scouting:=true", 'listen:=["tcp/0.0.0.0:7448"]', 'source:="/anna"', "__ns:=/anna/peers"):  # fmt: skip
        assert part in link
    assert "__ns:=/anna/peers" in joined
    assert 'agents:=["anna", "bert", "cleo"]' in joined
    assert 'map_frame:="peers_map"' in joined


def test_a_command_post_has_link_map_and_page(started: dict[str, Any]) -> None:
    result = CliRunner().invoke(slam, ["post", "--agents", "anna, bert", "--port", "0"])
    assert result.exit_code == 0, result.output
    assert started.keys() == {"radio_link", "sjsam", "dense_mapper", "viewer", "rest"}
    nodes = ("radio_link", "sjsam", "dense_mapper", "viewer")
    assert all('agents:=["anna", "bert"]' in started[name] for name in nodes)
    assert 'role:="post"' in started["radio_link"]
    assert "tsdf.min_images:=1" in started["dense_mapper"]
    assert 'listen:=["tcp/0.0.0.0:7447"]' in started["radio_link"]
    assert "port:=0" in started["viewer"]


def test_an_odometry_topic_goes_with_a_camera_and_with_topics(started: dict[str, Any], tmp_path: Path) -> None:
    words = ["live", "--topics", "--odometry-topic", "/base_controller/odom"]
    result = CliRunner().invoke(slam, words)
    assert result.exit_code == 0, result.output
    assert "/odometry:=/base_controller/odom" in started["rest"]
    folder = write_calibrations(DEMO, tmp_path / "calibration")[0]
    words = ["live", "0", "--calibration", str(folder), "--odometry-topic", "/base_controller/odom"]
    result = CliRunner().invoke(slam, words)
    assert result.exit_code == 0, result.output
    assert "/odometry:=/base_controller/odom" in started["rest"]
