# SPDX-License-Identifier: Apache-2.0
"""The real ``ros2 launch`` on the committed bag, where it can be installed (ros2cli, launch, launch_ros)."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sjsam_node.global_map import GlobalMap

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "bags" / "demo"
ROS2 = "import sys; sys.argv[0] = 'ros2'; from ros2cli.cli import main; sys.exit(main())"

pytestmark = [pytest.mark.ros, pytest.mark.slow]


class Launch:
    """``ros2 launch slam_bringup slam.launch.py`` in a session of its own."""

    def __init__(self, environment: dict[str, str], folder: Path, *arguments: str) -> None:
        for name in ("ros2cli", "ros2launch", "launch_ros"):
            pytest.importorskip(
                name, reason="ros2 launch is not installed: it has no wheel, only source (ros2cli, launch_ros)"
            )
        self._log = folder / "launch.log"
        environment = {**environment, "ROS_LOG_DIR": str(folder / "logs")}
        environment["PYTHONPATH"] = os.pathsep.join([environment.get("PYTHONPATH", ""), *sys.path])
        with self._log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-c", ROS2, "launch", "slam_bringup", "slam.launch.py", f"bag:={DEMO}", *arguments],
                env=environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def text(self) -> str:
        """What it has said so far."""
        return self._log.read_text()

    def wait(self, condition: Callable[[], bool], seconds: float = 400.0) -> None:
        """Until it has said something, or ended."""
        end = time.monotonic() + seconds
        while not condition() and self.process.poll() is None and time.monotonic() < end:
            time.sleep(0.5)

    def interrupt(self) -> None:
        """Ctrl-C as a terminal sends it: to the launch and to its nodes."""
        os.killpg(self.process.pid, signal.SIGINT)
        self.process.wait(60.0)


@contextmanager
def launched(*given: object) -> Iterator[Launch]:
    launch = Launch(*given)  # type: ignore[arg-type]
    try:
        yield launch
    finally:
        if launch.process.poll() is None:
            os.killpg(launch.process.pid, signal.SIGKILL)
            launch.process.wait()


def test_the_launch_file_plays_the_demo_through_all_nodes(domain_environment: dict[str, str], tmp_path: Path) -> None:
    options = (
        "mode:=fuse",
        "odometry:=ndt",
        "rate:=0",
        f"map_path:={tmp_path / 'map'}",
        "set:=ekf_slam.submap.max_distance=1.0",
    )
    with launched(domain_environment, tmp_path, *options) as launch:
        launch.wait(lambda: "played" in launch.text)
        text = launch.text
        launch.process.send_signal(signal.SIGINT)
        launch.process.wait(60.0)
    assert "played" in text, text[-3000:]
    assert "no progress" not in text, text[-3000:]
    assert "rejected" not in text, text[-3000:]
    assert "has died" not in text, text[-3000:]
    assert "Traceback" not in text, text[-3000:]


def test_ctrl_c_ends_all_nodes_with_the_map_on_disk(domain_environment: dict[str, str], tmp_path: Path) -> None:
    options = ("rate:=0.5", f"map_path:={tmp_path / 'map'}", "set:=ekf_slam.submap.max_distance=0.5")
    with launched(domain_environment, tmp_path, *options) as launch:
        copy = tmp_path / "map.autosave"
        launch.wait((copy / "manifest.json").exists)
        launch.interrupt()
        text = launch.text
    started = set(re.findall(r"\[([\w.]+-\d+)\]: process started", text))
    finished = set(re.findall(r"\[([\w.]+-\d+)\]: process has finished cleanly", text))
    assert len(started) >= 5
    assert started == finished, text[-3000:]
    assert "Traceback" not in text, text[-3000:]
    assert launch.process.returncode == 0, text[-3000:]
    assert len(GlobalMap.load(tmp_path / "map.autosave.ended").snapshot())
