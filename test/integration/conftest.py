# SPDX-License-Identifier: Apache-2.0
"""The built workspace, a small bag, and a private ROS domain for tests with real processes."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_bringup.processes.processes import PrivateDomain, node_environment
from slam_core.camera import Camera
from slam_core.messages import rectified_info

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture(scope="session")
def workspace() -> dict[str, str]:
    """Environment of the built workspace, as sourcing it gives."""
    pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    setup = ROOT / "install" / "local_setup.sh"
    if not setup.exists():
        pytest.skip("the workspace is not built (./slam setup)")
    script = f'COLCON_CURRENT_PREFIX="{setup.parent}" . "{setup}" && env -0'
    out = subprocess.run(["sh", "-c", script], check=True, capture_output=True, text=True).stdout
    return dict(line.split("=", 1) for line in out.split("\0") if "=" in line)


@pytest.fixture
def domain_environment(workspace: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Environment of nodes in a domain of their own; the workspace is in this process's environment too."""
    for name in ("AMENT_PREFIX_PATH", "PYTHONPATH"):
        monkeypatch.setenv(name, workspace.get(name, ""))
    with PrivateDomain() as domain:
        yield node_environment(domain) | {"PATH": workspace.get("PATH", os.environ["PATH"])}


@pytest.fixture(scope="session")
def small_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of noise from a stereo and a depth camera: nothing to map, but every topic.

    Long enough to be played in a loop: where half the frames are lost, each time round still has three that agree.
    """
    rng = np.random.default_rng(7)
    camera = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)
    path = tmp_path_factory.mktemp("bags") / "small"
    with BagWriter(path) as bag:
        writer = SensorWriter(bag)
        writer.extrinsics(10**9, {LEFT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_OPTICAL})
        for i in range(30):
            stamp = 10**9 + i * 10**8
            left, right = rng.integers(0, 256, (2, 120, 160), dtype=np.uint8)
            writer.stereo(stamp, left, right, (rectified_info(camera), rectified_info(camera, 0.1)))
            depth = rng.integers(1000, 3000, (120, 160)).astype(np.uint16)
            writer.depth(stamp, depth, rectified_info(camera), measurement="range", amplitude=left, intensity=right)
    return path
