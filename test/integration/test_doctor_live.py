# SPDX-License-Identifier: Apache-2.0
"""``slam doctor --live`` on a running graph: a rig that is played, as it is and with its cameras exchanged."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import NodeCommand, NodeGroup

DEMO = Path(__file__).resolve().parents[2] / "bags" / "demo"

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def examined(bag: Path, environment: dict[str, str], folder: Path) -> subprocess.CompletedProcess[str]:
    """What the doctor says of a rig that publishes what is in a bag."""
    player = {"bag": str(bag), "rate": 0.5, "wait_for_subscribers": 60.0}
    with NodeGroup(environment, folder / "logs") as group:
        group.start(NodeCommand("slam_bags", "bag_player", tuple(ros_arguments(player))))
        command = [sys.executable, "-m", "slam_bringup.cli", "doctor", "--live", "--seconds", "8"]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_a_good_rig_is_found_good(domain_environment: dict[str, str], tmp_path: Path) -> None:
    done = examined(DEMO, domain_environment, tmp_path)
    assert "nothing wrong found" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


def test_exchanged_cameras_are_named(domain_environment: dict[str, str], tmp_path: Path) -> None:
    exchanged = {"left": "right", "right": "left"}
    with BagReader(DEMO) as old, BagWriter(tmp_path / "bag") as new:
        for topic, stamp, message in old.messages():
            parts = topic.split("/")
            if "image" in parts[-1] or "image" in parts[-2]:
                topic = "/".join(exchanged.get(part, part) for part in parts)
            new.write(topic, message, stamp)
    done = examined(tmp_path / "bag", domain_environment, tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "swapped" in done.stdout


def test_where_nothing_is_published_the_next_step_is_said(domain_environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "slam_bringup.cli", "doctor", "--live", "--seconds", "1"]
    done = subprocess.run(command, env=domain_environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "the running graph has no images" in done.stderr
    assert "--topic left=" in done.stderr
