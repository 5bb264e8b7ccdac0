# SPDX-License-Identifier: Apache-2.0
"""A process whose starter has died ends, even if it hangs, and says where."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from slam_core.runtime.process_life import PARENT

_HANGS = """
import time
from slam_core.runtime import process_life as life
life._ORPHAN_ENDS_S = 0.2
life.on_request_to_end(lambda *_: None)
life.end_with_parent()
print("begun", flush=True)
while True:
    time.sleep(0.05)
"""

_STARTS = """
import os, subprocess, sys
environment = dict(os.environ, **{sys.argv[1]: str(os.getpid())})
child = subprocess.Popen([sys.executable, "-c", sys.argv[2]], env=environment, stderr=open(sys.argv[3], "w"))
print(child.pid, flush=True)
child.wait()
"""


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel tells of the death of a parent on Linux only")
def test_a_process_that_hangs_does_not_outlive_its_starter(tmp_path: Path) -> None:
    log = tmp_path / "log"
    command = [sys.executable, "-c", _STARTS, PARENT, _HANGS, str(log)]
    starter = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert starter.stdout is not None
    child = int(starter.stdout.readline())
    assert starter.stdout.readline() == "begun\n"
    starter.kill()
    starter.wait()
    end = time.monotonic() + 60.0
    while _lives(child) and time.monotonic() < end:
        time.sleep(0.02)
    assert not _lives(child), os.kill(child, 9)
    assert "Timeout" in log.read_text()
    assert 'File "<string>"' in log.read_text()
