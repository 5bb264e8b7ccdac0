# SPDX-License-Identifier: Apache-2.0
"""What one process of the tests makes and all of them use; and the tutorial's commands, run as they are typed."""

from __future__ import annotations

import fcntl
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def made_once(base: Path, name: str, make: Callable[[Path], None]) -> Path:
    """A folder below the session's ``base`` that the first process fills; the others wait, and fail as it did."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder, done = base / name, base / f"{name}.done"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            folder.mkdir()
            try:
                make(folder)
            except BaseException as error:
                done.write_text(f"{type(error).__name__}: {error}")
                raise
            done.touch()
    failed = done.read_text()
    assert not failed, failed
    return folder


def run_tutorial(folder: Path) -> None:
    """Run the page's lines in a folder with ./slam and the demo bag; each that ended well is in ``<number>.run``."""
    script = folder / "slam"
    script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m slam_bringup.cli "$@"\n')
    script.chmod(0o755)
    (folder / "bags").symlink_to(ROOT / "bags")
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "docs/tutorial.md").read_text(encoding="utf-8"), flags=re.S)
    lines = re.findall(r"^\./slam .*$", "\n".join(blocks), flags=re.M)
    assert len(lines) == 4
    sources = os.pathsep.join(str(p) for p in sorted((ROOT / "src").iterdir()))
    for number, line in enumerate(lines):
        command, environment = ["bash", "-c", line], os.environ | {"PYTHONPATH": sources}
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
        (folder / f"{number}.run").write_text(line)
