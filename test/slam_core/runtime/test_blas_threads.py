# SPDX-License-Identifier: Apache-2.0
"""BLAS has one thread in every node, however it is started, unless the environment gives a number."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from slam_core.runtime.blas_threads import VARIABLE

START = """
import numpy
from slam_core.runtime.blas_threads import use_one_blas_thread
use_one_blas_thread()
import scipy.linalg
from threadpoolctl import threadpool_info
print(sorted({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}))
"""


@pytest.mark.parametrize(("given", "threads"), [(None, "[1]"), ("2", "[2]")])
def test_blas_has_one_thread_unless_the_environment_gives_a_number(given: str | None, threads: str) -> None:
    if (os.cpu_count() or 1) < 2:
        pytest.skip("OpenBLAS has one thread on one core")
    assert printed(START, {VARIABLE: given} if given else {}) == threads


@pytest.mark.ros
@pytest.mark.parametrize("run", ["slam_core.ros.run_node", "slam_bringup.processes.composed_node.run_composed"])
def test_nodes_have_one_blas_thread_before_they_begin(run: str) -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    module, name = run.rsplit(".", 1)
    script = f"""
import rclpy, {module} as module
from threadpoolctl import threadpool_info
def stop(*_, **__):
    print(sorted({{pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}}))
    raise SystemExit
rclpy.init = stop
module.{name}([])
"""
    assert printed(script, {}) == "[1]"


def test_a_rig_of_the_library_has_one_blas_thread() -> None:
    if (os.cpu_count() or 1) < 2:
        pytest.skip("OpenBLAS has one thread on one core")
    script = """
from indoor_slam import Camera, CameraInfo, DepthSlam
from threadpoolctl import threadpool_info
DepthSlam(CameraInfo(Camera(64, 48, 50.0, 50.0, 31.5, 23.5)))
print(sorted({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}))
"""
    assert printed(script, {}) == "[1]"


def printed(script: str, own: dict[str, str]) -> str:
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE} | own
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout.strip()
