# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import (
    NodeCommand,
    NodeGroup,
    NodeProcess,
    PrivateDomain,
    find_executable,
    node_environment,
)


def install(prefix: Path, package: str, executable: str, script: str) -> Path:
    """An executable as colcon installs it."""
    marker = prefix / "share" / "ament_index" / "resource_index" / "packages" / package
    path = prefix / "lib" / package / executable
    for file in (marker, path):
        file.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()
    path.write_text(f"#!{sys.executable}\n{script}")
    path.chmod(0o755)
    return path


def test_the_ament_index_comes_before_the_modules(tmp_path: Path) -> None:
    path = install(tmp_path, "sjsam_node", "sjsam", "")
    assert find_executable("sjsam_node", "sjsam", [str(tmp_path)]) == [str(path)]
    assert find_executable("sjsam_node", "sjsam", [])[0] == sys.executable
    with pytest.raises(ValueError, match="no executable 'x' in package 'y'"):
        find_executable("y", "x", [])


def start(tmp_path: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> NodeProcess:
    install(tmp_path, "pkg", "node", script)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    return NodeProcess.start(NodeCommand("pkg", "node"), tmp_path / "node.log", node_environment(1))


def wait_for(node: NodeProcess, text: str) -> None:
    end = time.monotonic() + 20.0
    while text not in node.log.read_text() and time.monotonic() < end:
        time.sleep(0.02)
    assert text in node.log.read_text()


def test_a_node_is_stopped_by_sigint_and_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = (
        "import signal, sys, time\n"
        "count = []\n"
        "signal.signal(signal.SIGINT, lambda *_: count.append(1))\n"
        "print('up')\n"
        "while not count: time.sleep(0.01)\n"
        "time.sleep(0.2)\n"
        "sys.exit(len(count) - 1)\n"
    )
    node = start(tmp_path, script, monkeypatch)
    wait_for(node, "up")
    node.interrupt()
    assert node.stop() == 0


def test_a_node_that_died_is_reported_with_the_end_of_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "pkg", "node", "raise SystemExit('no camera')")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with NodeGroup(node_environment(1), tmp_path / "logs") as group:
        group.start(NodeCommand("pkg", "node")).process.wait(20)
        with pytest.raises(ValueError, match=r"node /node ended with code 1:\nno camera"):
            group.check()
    assert group.exit_codes == {"/node": 1}


def test_domains_are_private() -> None:
    with PrivateDomain() as first, PrivateDomain() as second:
        assert first != second
        assert {first, second} <= set(range(1, 101))


@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
def test_two_users_share_the_domains_of_a_machine() -> None:
    script = (
        "import os\n"
        "from slam_bringup.processes.processes import PrivateDomain\n"
        "os.setgid(65534), os.setuid(65534)\n"
        "with PrivateDomain() as domain: print(domain)"
    )
    own = [PrivateDomain() for _ in range(3)]
    held = {domain.__enter__() for domain in own}
    try:
        out = subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
        )
    finally:
        for domain in own:
            domain.__exit__()
    assert out.stdout.strip() in {str(d) for d in range(1, 101)} - {str(d) for d in held}, out.stderr


def test_arguments_are_those_of_ros2_run() -> None:
    arguments = ros_arguments({"rate": 2.0, "loop": True, "topics": ("/a", "/b"), "pace": (), "bag": "a b"}, "one")
    assert arguments == [
        "--ros-args", "-r", "__ns:=/one", "-p", "rate:=2.0", "-p", "loop:=true", "-p", 'topics:=["/a", "/b"]',
        "-p", 'bag:="a b"',
    ]  # fmt: skip
