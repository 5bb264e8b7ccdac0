# SPDX-License-Identifier: Apache-2.0
"""What ``ros2 run`` would start: found through the ament index, ready, heard, and ended by SIGINT without a word."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam_bags.storage.bag import BagReader
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import NodeCommand, NodeGroup, NodeProcess, find_executable

pytestmark = pytest.mark.ros

ESTIMATORS = (
    ("stereo_frontend", "stereo_driver"),
    ("stereo_frontend", "feature_extractor"),
    ("tof_driver", "tof_driver"),
    ("ndt_registration", "ndt_odometry"),
    ("ekf_slam_node", "ekf_slam"),
    ("sjsam_node", "sjsam"),
)
TOOLS = (
    ("dense_mapping", "dense_mapper"),
    ("slam_radio", "radio_link"),
    ("slam_bags", "bag_player"),
    ("slam_bags", "recorder"),
    ("slam_viewer", "viewer"),
    ("slam_bringup", "slam_composed"),
)
RECORDED = ("/stereo/left/image_rect", "/tof/points", "/features", "/odom", "/ndt/odometry", "/diagnostics")


@pytest.mark.parametrize(("package", "executable"), [*ESTIMATORS, *TOOLS])
def test_the_ament_index_knows_the_executable(workspace: dict[str, str], package: str, executable: str) -> None:
    command = find_executable(package, executable, workspace["AMENT_PREFIX_PATH"].split(":"))
    assert Path(command[0]).name == executable
    assert len(command) == 1


def test_every_node_starts_publishes_and_stops_on_sigint(
    domain_environment: dict[str, str], small_bag: Path, tmp_path: Path
) -> None:
    from slam_bringup.processes.supervisor_node import Supervisor

    recording = tmp_path / "recording"
    parameters = ros_arguments({"bag": str(small_bag), "loop": True})
    player = NodeCommand("slam_bags", "bag_player", tuple(parameters))
    recorder = NodeCommand("slam_bags", "recorder", tuple(ros_arguments({"bag": str(recording)})))
    with (
        NodeGroup(domain_environment, tmp_path / "logs") as group,
        Supervisor(domain_environment, group.check) as supervisor,
    ):
        nodes = [group.start(NodeCommand(*names)) for names in ESTIMATORS]
        nodes += [group.start(recorder), group.start(player)]
        heard = supervisor.diagnostics
        supervisor.wait(lambda: all(f"/{e}" in heard for _, e in ESTIMATORS), 60.0, "a report of every node")
        log = nodes[-2].log
        supervisor.wait(lambda: all(f"recording {t}" in log.read_text() for t in RECORDED), 60.0, "the recorder")
        before = supervisor.progress["/ekf_slam"]
        supervisor.wait(lambda: supervisor.progress["/ekf_slam"] > before, 60.0, "a frame through the whole chain")
        supervisor.wait(lambda: int(heard["/ndt_odometry"].get("processed", 0)) > 3, 60.0, "scans registered")
        supervisor.listen(1.0)
        group.stop()
        failed = [node for node in nodes if group.exit_codes[node.command.full_name] != 0]
    assert not failed, [(group.exit_codes[node.command.full_name], node.diagnostic()) for node in failed]
    for node in nodes:
        check_log(node)
    with BagReader(recording) as bag:
        topics = bag.topics
    for topic in RECORDED:
        assert topics[topic].count > 0, topic


def check_log(node: NodeProcess) -> None:
    log = node.log.read_text()
    assert "ready" in log
    assert "Traceback" not in log, log
    assert "terminate called" not in log, log


@pytest.mark.parametrize(
    ("parameters", "text"),
    [({"input.depht": 3}, "unknown parameter 'depht'"), ({"input.depth": 0}, "must be at least 1")],
)
def test_bad_parameters_are_refused_in_one_line(
    domain_environment: dict[str, str], tmp_path: Path, parameters: dict[str, int], text: str
) -> None:
    command = NodeCommand("tof_driver", "tof_driver", tuple(ros_arguments(parameters)))
    node = NodeProcess.start(command, tmp_path / "node.log", domain_environment)
    assert node.process.wait(60) == 2
    assert text in node.log.read_text()
    assert "Traceback" not in node.log.read_text()
