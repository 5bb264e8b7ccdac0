# SPDX-License-Identifier: Apache-2.0
"""A process of ``sjsam`` is told to load what is no map and may never end: it refuses, goes on and ends when asked."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

pytest.importorskip("rclpy")
pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("domain")]

from joiner_process import call, neighbour, running  # noqa: E402


def _huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**42)


KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a pipe": (os.mkfifo, "a file is needed"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "a file is needed"),
    "a folder": (Path.mkdir, "is a folder"),
    "a file without end": (_huge, "bytes, more than"),
    "nested lists": (lambda path: path.write_text("[" * 10**6), ""),
}


def test_what_may_never_end_is_not_read_and_the_node_goes_on(rng: np.random.Generator, tmp_path: Path) -> None:
    good, folder = tmp_path / "good", tmp_path / "map"
    join(Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.3), rng, "a").submaps()[:3])[0].save(good)
    parts = ["manifest.json", next(good.glob("arrays-*.npz")).name]
    with running(f"map_path:={folder}") as node:
        with neighbour() as probe:
            for part in parts:
                for name, (make, why) in KINDS.items():
                    shutil.rmtree(folder, ignore_errors=True)
                    shutil.copytree(good, folder)
                    (folder / part).unlink()
                    make(folder / part)
                    answer = call(probe, "load_map")
                    assert not answer.success, (part, name)
                    assert answer.message.startswith(f"{folder}: "), (part, name, answer.message)
                    assert why in answer.message, (part, name, answer.message)
            shutil.rmtree(folder)
            shutil.copytree(good, folder)
            assert call(probe, "load_map").success
        peak_kb = next(line for line in Path(f"/proc/{node.pid}/status").read_text().splitlines() if "VmHWM" in line)
        assert int(peak_kb.split()[1]) < 10**6, peak_kb
        node.send_signal(signal.SIGINT)
        assert node.wait(20) == 0
