# SPDX-License-Identifier: Apache-2.0
"""An installation without one of the extras: what runs, and what says in one line what to install."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from slam_bringup.cli import slam
from slam_bringup.commands import demo, nodes, run
from slam_bringup.extras import EXTRA_OF, advice_for
from slam_bringup.processes.kernels import DEMO

WITHOUT = "import sys; sys.modules[sys.argv.pop(1)] = None; from slam_bringup.cli import main; main()"


def said_without(module: str, *arguments: object, cwd: Path) -> str:
    """What the program says last, before exit code 2, where a module is missing."""
    command = [sys.executable, "-c", WITHOUT, module, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, env=os.environ, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("rclpy", ("play", DEMO), "ros"),
        ("rclpy", ("record", "-o", "bag"), "ros"),
        ("rclpy", ("demo", "--rate", "1"), "ros"),
        ("rclpy", ("live", "--topics"), "ros"),
        ("distributed", ("experiment", "planar", "--quick", "--workers", "2", "-o", "page"), "scale"),
        ("distributed", ("merge", DEMO, "--workers", "2", "-o", "merged"), "scale"),
    ],
)
def test_a_command_whose_extra_is_missing_says_what_to_install(tmp_path, module, arguments, extra):
    assert f"pip install 'indoor-slam[{extra}]'" in said_without(module, *arguments, cwd=tmp_path)
    assert not list(tmp_path.rglob("*.html")) + list(tmp_path.rglob("*.mcap")), "half-done results"


def test_a_module_that_no_extra_brings_is_not_explained_away():
    assert advice_for(ModuleNotFoundError("", name="slam_core.nothing")) is None
    assert all(advice_for(ModuleNotFoundError("", name=f"{name}.part")) for name in EXTRA_OF)


def test_the_demo_is_mapped_offline_without_ros(monkeypatch, tmp_path):
    given: list[dict[str, Any]] = []
    monkeypatch.setattr(demo, "has_ros", lambda: False)
    monkeypatch.setattr(run.command, "callback", lambda **options: given.append(options))
    result = CliRunner().invoke(slam, ["demo", "-o", str(tmp_path / "out"), "--imu", "off"])
    assert result.exit_code == 0, result.output
    assert "mapped offline" in result.stderr
    (options,) = given
    assert options.keys() == {parameter.name for parameter in run.command.params if parameter.expose_value}
    assert (options["bags"], options["mode"], options["odometry"], options["imu"]) == ((DEMO,), "fuse", "ndt", "off")


def test_the_demo_is_mapped_by_the_nodes_in_one_process(monkeypatch, tmp_path):
    given: list[dict[str, Any]] = []
    monkeypatch.setattr(demo, "has_ros", lambda: True)
    monkeypatch.setattr(nodes.command, "callback", lambda **options: given.append(options))
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(slam, ["demo"]).exit_code == 0
    (options,) = given
    assert options.keys() == {parameter.name for parameter in nodes.command.params if parameter.expose_value}
    assert (options["bag"], options["mode"], options["odometry"], options["composed"]) == (DEMO, "fuse", "ndt", True)
    assert options["output"] == Path("out/demo")
