# SPDX-License-Identifier: Apache-2.0
"""The real ``ros2 launch`` on the committed bag, where it can be installed (ros2cli, launch, launch_ros)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "bags" / "demo"
ROS2 = "import sys; sys.argv[0] = 'ros2'; from ros2cli.cli import main; sys.exit(main())"

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def test_the_launch_file_plays_the_demo_through_all_nodes(
    domain_environment: dict[str, str], tmp_path: Path
) -> None:  # fmt: skip
    for name in ("ros2cli", "ros2launch", "launch_ros"):
        pytest.importorskip(
            name, reason="ros2 launch is not installed: it has no wheel, only source (ros2cli, launch_ros)"
        )
    log = tmp_path / "launch.log"
    arguments = [f"bag:={DEMO}", "mode:=fuse", "odometry:=ndt", "rate:=0", "set:=ekf_slam.submap.max_distance=1.0"]
    environment = {**domain_environment, "ROS_LOG_DIR": str(tmp_path / "logs")}
    environment["PYTHONPATH"] = os.pathsep.join([domain_environment.get("PYTHONPATH", ""), *sys.path])
    with log.open("wb") as output:
        launch = subprocess.Popen(
            [sys.executable, "-c", ROS2, "launch", "slam_bringup", "slam.launch.py", *arguments],
            env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
    try:
        end = time.monotonic() + 400.0
        while "played" not in log.read_text() and launch.poll() is None and time.monotonic() < end:
            time.sleep(0.5)
        text = log.read_text()
    finally:
        launch.send_signal(signal.SIGINT)
        try:
            launch.wait(60.0)
        finally:
            if launch.poll() is None:
                os.killpg(launch.pid, signal.SIGKILL)
    assert "played" in text, text[-3000:]
    assert "has died" not in text, text[-3000:]
    assert "Traceback" not in text, text[-3000:]
