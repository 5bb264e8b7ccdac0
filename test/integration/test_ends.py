# SPDX-License-Identifier: Apache-2.0
"""How a run of nodes ends: with its terminal, with its starter, on Ctrl-C, and at once where its input cannot work."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sjsam_node.global_map import GlobalMap

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "bags" / "demo"

_MAPPED_S = 9.0
"""From ready nodes to some seconds of the bag, so that there is a map: they find each other first."""

pytestmark = [pytest.mark.ros, pytest.mark.slow]


class Run:
    """``slam nodes`` in a session of its own, as a terminal starts it."""

    def __init__(self, environment: dict[str, str], out: Path, *options: str) -> None:
        command = [sys.executable, "-m", "slam_bringup.cli", "nodes", str(DEMO), "-o", str(out), *options]
        self.out = out
        self.process = subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=hear_the_terminal,
        )

    def nodes(self) -> list[int]:
        """Processes that name the output folder or were started by this run, and still live."""
        return [pid for pid in map(int, filter(str.isdigit, os.listdir("/proc"))) if self._is_node(pid)]

    def _is_node(self, pid: int) -> bool:
        try:
            environment = Path(f"/proc/{pid}/environ").read_bytes()
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        return f"SLAM_PARENT_PID={self.process.pid}".encode() in environment and state != "Z"


def hear_the_terminal() -> None:
    """Whoever runs the tests under nohup has SIGHUP ignored, which programs inherit."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def wait_for(condition: Callable[[], bool], timeout_s: float = 120.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.fixture
def options() -> list[str]:
    return []


@pytest.fixture
def run(workspace: dict[str, str], tmp_path: Path, options: list[str]) -> Iterator[Run]:
    run = Run(workspace, tmp_path / "out", "--rate", "0.5", *options)
    yield run
    if run.process.poll() is None:
        run.process.kill()
    run.process.wait()


def is_playing(run: Run) -> bool:
    player, *others = (run.out / "logs" / f"{name}.log" for name in ("bag_player", "ekf_slam", "slam_composed"))
    is_ready = player.exists() and "ready" in player.read_text()
    return is_ready and any(log.exists() and "ready" in log.read_text() for log in others)


def test_a_killed_run_leaves_no_nodes(run: Run) -> None:
    assert wait_for(lambda: is_playing(run)), run.process.poll()
    assert len(run.nodes()) >= 5
    run.process.kill()
    assert wait_for(lambda: not run.nodes(), 30.0), [log.read_text()[-3000:] for log in run.out.glob("logs/*.log")]


@pytest.mark.parametrize(
    ("number", "options"),
    [(signal.SIGHUP, ["--composed"]), (signal.SIGINT, []), (signal.SIGTERM, ["--composed"])],
    ids=["hangup", "ctrl-c", "terminate"],
)
def test_a_run_that_is_asked_to_end_writes_what_is_mapped(run: Run, number: signal.Signals) -> None:
    assert wait_for(lambda: is_playing(run))
    time.sleep(_MAPPED_S)
    assert run.process.stdout is not None
    if number == signal.SIGHUP:
        run.process.stdout.close()  # a terminal that is closed takes no more words
    run.process.send_signal(number)
    code = run.process.wait(240.0)
    assert code == 130, "" if run.process.stdout.closed else run.process.stdout.read()
    assert not run.nodes()
    summary = json.loads((run.out / "summary.json").read_text())
    assert 0 < summary["frames"] < 52
    assert any("stopped before the end" in event for event in summary["events"])
    assert (run.out / "map" / "manifest.json").exists()


@pytest.mark.parametrize("options", [["--composed"]], ids=["composed"])
def test_a_second_ctrl_c_leaves_at_once_with_the_map(run: Run) -> None:
    assert wait_for(lambda: is_playing(run))
    time.sleep(_MAPPED_S)
    run.process.send_signal(signal.SIGINT)
    assert wait_for(lambda: any(run.out.glob(".slam.*.part/map/manifest.json")))
    run.process.send_signal(signal.SIGINT)
    assert run.process.wait(60.0) == 130
    assert run.process.stdout is not None
    assert f"the map is in {run.out / 'map'}" in run.process.stdout.read()
    assert len(GlobalMap.load(run.out / "map").snapshot())
    assert not (run.out / "summary.json").exists()
    assert not run.nodes()


def test_nohup_is_respected(workspace: dict[str, str], tmp_path: Path) -> None:
    script = "from slam_bringup.processes.interrupt import Interrupt; import os, signal\n"
    script += "with Interrupt() as i: os.kill(os.getpid(), signal.SIGHUP); print(i.asked)"
    command = ["sh", "-c", f"trap '' HUP; exec {sys.executable} -c '{script}'"]
    out = subprocess.run(command, env=workspace, capture_output=True, text=True, check=True).stdout
    assert out.strip() == "False"
