# SPDX-License-Identifier: Apache-2.0
"""The script ``./slam`` keeps an environment that a user has added to, and compiles kernels before they are needed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PYTHON = """#!/bin/sh
case "$*" in
  *"import rclpy"*) exit {rclpy} ;;
  *"-m venv"*) for last; do :; done; mkdir -p "$last/bin"; cp "$0" "$last/bin/python" ;;
  *get_path*) echo "{root}" ;;
esac
echo "python $*" >>"{root}/calls"
echo "$PYTHONPATH:" >"{root}/pythonpath"
"""
COLCON = """#!/bin/sh
mkdir -p "{root}/install" && touch "{root}/install/setup.bash" "{root}/install/local_setup.sh"
"""


class Clone:
    """A clone with stand-ins for Python and colcon, which only note how they are called."""

    def __init__(self, root: Path) -> None:
        self.root, self.venv = root, root / ".venv"
        for name in ("slam", *(f"requirements{kind}.txt" for kind in ("", "-experiments", "-ros", "-dev"))):
            shutil.copy2(ROOT / name, root / name)
        package = root / "src" / "slam_bringup"
        for folder in ("launch", "config", "rviz"):
            (package / folder).mkdir(parents=True)
        for name in ("setup.py", "package.xml", "setup.cfg"):
            (package / name).touch()
        (package / "kernels.py").write_text("from numba import njit\nclass Row(NamedTuple): ...\n")
        (root / "bin").mkdir()
        self.script("bin/python3", PYTHON, rclpy=1)
        self.script("bin/colcon", COLCON)

    def script(self, name: str, text: str, **values: object) -> None:
        (self.root / name).write_text(text.format(root=self.root, **values))
        (self.root / name).chmod(0o755)

    def slam(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        (self.root / "calls").write_text("")
        own = {"PATH": f"{self.root}/bin:/usr/bin:/bin", "HOME": str(self.root)}
        return subprocess.run(
            ["./slam", *arguments], cwd=self.root, env=own | environment, capture_output=True, text=True
        )

    @property
    def calls(self) -> str:
        return (self.root / "calls").read_text()


@pytest.fixture
def clone(tmp_path: Path) -> Clone:
    made = Clone(tmp_path)
    first = made.slam("--help")
    assert first.returncode == 0, first.stderr
    assert "-m venv" in made.calls
    (made.venv / "added").write_text("by the user")
    return made


def test_a_sourced_ros_does_not_replace_an_environment_from_pypi(clone: Clone) -> None:
    prefix = clone.root / "opt" / "jazzy"
    result = clone.slam(
        "--help",
        ROS_DISTRO="jazzy",
        AMENT_PREFIX_PATH=str(prefix),
        PYTHONPATH=f"{prefix}/lib/site-packages:/mine",
    )
    assert result.returncode == 0, result.stderr
    assert (clone.venv / "added").read_text() == "by the user"
    assert "-m venv" not in clone.calls
    assert "pip install" not in clone.calls
    assert "using the ROS 2 from PyPI in .venv, not the sourced jazzy" in result.stderr
    assert (clone.root / "pythonpath").read_text() == "/mine:\n"


def test_an_environment_for_a_sourced_ros_asks_for_it(clone: Clone) -> None:
    shutil.rmtree(clone.venv)
    clone.script("bin/python3", PYTHON, rclpy=0)
    assert clone.slam("--help", ROS_DISTRO="jazzy").returncode == 0
    (clone.venv / "added").touch()
    assert clone.slam("--help", ROS_DISTRO="jazzy").stderr == ""
    clone.script(".venv/bin/python", PYTHON, rclpy=1)
    result = clone.slam("--help")
    assert result.returncode == 2
    assert ".venv was made for ROS 2 jazzy: source that" in result.stderr
    assert (clone.venv / "added").exists()


def test_a_clone_that_was_copied_keeps_the_environment_aside(clone: Clone) -> None:
    (clone.venv / ".made-by-slam").write_text("/elsewhere pypi \n")
    for stamp in clone.venv.glob(".stamp-packages*"):
        stamp.write_text("/elsewhere pypi 1 2\n")
    result = clone.slam("--help")
    assert result.returncode == 0, result.stderr
    assert "-m venv" in clone.calls
    assert [p.read_text() for p in clone.root.glob(".venv-*/added")] == ["by the user"]


@pytest.mark.parametrize(
    "command", ["run", "nodes", "live", "register", "join", "plane", "experiment", "demo", "setup"]
)
def test_kernels_are_compiled_before_the_command_that_needs_them(clone: Clone, command: str) -> None:
    clone.slam(command, "x")
    assert clone.calls.count("slam_bringup.cli warmup") == 1
    clone.slam(command, "x")
    assert "warmup" not in clone.calls


def test_the_demo_does_without_what_other_commands_need(tmp_path: Path) -> None:
    made = Clone(tmp_path)
    assert made.slam("demo").returncode == 0
    order = [made.calls.index(step) for step in ("-m pip install", "slam_bringup.cli warmup", "slam_bringup.cli demo")]
    assert order == sorted(order)
    assert made.calls.count("requirements-ros.txt") == 1
    assert "compileall -qq -j 0" not in made.calls
    assert not (made.root / "install").exists()
    assert made.slam("doctor", "x").returncode == 0
    assert "pip install" not in made.calls
    assert "compileall -qq -j 0" in made.calls
    assert (made.root / "install" / "setup.bash").exists()
    assert made.slam("doctor", "x").returncode == 0
    assert "compileall" not in made.calls


def test_the_demo_is_that_of_this_clone_beside_another_workspace(tmp_path: Path) -> None:
    made = Clone(tmp_path)
    assert made.slam("demo", AMENT_PREFIX_PATH="/elsewhere/install").returncode == 0
    assert (made.root / "install" / "setup.bash").exists()


def test_packages_that_cannot_be_installed_end_it(tmp_path: Path) -> None:
    made = Clone(tmp_path)
    failing = PYTHON.replace(
        "case", 'case "$*" in *"pip install"*ros.txt*) echo no such package; exit 1 ;; esac\ncase', 1
    )
    made.script("bin/python3", failing, rclpy=1)
    result = made.slam("demo")
    assert result.returncode == 2
    assert "no such package" in result.stderr
    assert not list(made.venv.glob(".stamp-packages*"))


@pytest.mark.parametrize("arguments", [("run", "--help"), ("evaluate", "run", "nodes"), ("doctor", "x"), ("--help",)])
def test_other_commands_do_not_wait_for_kernels(clone: Clone, arguments: tuple[str, ...]) -> None:
    clone.slam(*arguments)
    assert "warmup" not in clone.calls
    assert "slam_bringup.cli " + " ".join(arguments) in clone.calls
