# SPDX-License-Identifier: Apache-2.0
"""What holds for every command."""

from __future__ import annotations

import importlib
import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from slam_bringup.cli import COMMANDS, VERSION, slam
from slam_bringup.registered_commands import registered_commands
from slam_bringup.terminal.console import progress_bar, show
from slam_experiments.command_table import COMMANDS as REGISTERED

COMMAND = [sys.executable, "-m", "slam_bringup.cli"]
SOURCES = Path(__file__).resolve().parents[2] / "src"


def test_the_version_is_that_of_the_packages() -> None:
    assert VERSION in CliRunner().invoke(slam, ["--version"]).output
    for package in SOURCES.glob("*/package.xml"):
        assert re.search(r"<version>(.*)</version>", package.read_text())[1] == VERSION, package


def test_the_shell_completes_commands_and_options() -> None:
    """As a shell asks, once ``eval "$(_SLAM_COMPLETE=bash_source slam)"`` has been said."""

    def asked(words: str) -> list[str]:
        place = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_SLAM_COMPLETE": "bash_complete"}
        done = subprocess.run(COMMAND, env=os.environ | place, capture_output=True, text=True, check=False)
        return [line.partition(",")[2] for line in done.stdout.splitlines()]

    assert asked("slam re") == ["record", "register"]
    assert "--localize-only" in asked("slam run --l")
    source = subprocess.run(
        COMMAND, env=os.environ | {"_SLAM_COMPLETE": "bash_source"}, capture_output=True, text=True, check=False
    )
    assert "complete" in source.stdout


def test_a_misspelt_command_comes_with_the_one_that_was_meant() -> None:
    result = CliRunner().invoke(slam, ["rnu"])
    assert result.exit_code == 2
    assert "No such command 'rnu'. Did you mean run?" in result.output
    assert "Did you mean" not in CliRunner().invoke(slam, ["xyzzy"]).output


@click.command()
def talkative() -> None:
    logging.getLogger("slam_bringup.x").debug("everything")
    logging.getLogger("slam_bringup.x").info("more")
    logging.getLogger("numba.core").error("noise")
    with progress_bar() as bar:
        bar.add_task("bar", total=2)
    show("table")
    logging.getLogger("slam_bringup.x").error("error")


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [([], [], "table error"), (["-q"], [], "error"), ([], ["-q"], "error"), ([], ["-v"], "more table error"),
     (["-vv"], [], "everything more table error")],
)  # fmt: skip
def test_how_much_is_said_is_chosen_before_or_behind_the_command(before, after, said, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "slam_bringup.commands.talkative", SimpleNamespace(command=talkative))
    monkeypatch.setitem(COMMANDS, "talkative", "says something")
    result = CliRunner().invoke(slam, [*before, "talkative", *after], catch_exceptions=False)
    words = [w for w in result.output.split() if w in ("everything", "more", "noise", "table", "error")]
    assert sorted(words) == sorted(said.split())
    assert not [h for h in logging.getLogger().handlers if type(h) is logging.StreamHandler], "it ends with the command"


@click.command()
def endless() -> None:
    raise KeyboardInterrupt


def test_ctrl_c_ends_every_command_with_its_exit_code(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "slam_bringup.commands.endless", SimpleNamespace(command=endless))
    monkeypatch.setitem(COMMANDS, "endless", "does not end")
    result = CliRunner().invoke(slam, ["endless"])
    assert result.exit_code == 130
    assert result.output == "\nstopped\n"


@pytest.mark.parametrize("name", [*COMMANDS, *REGISTERED])
def test_every_command_has_its_help(name: str) -> None:
    result = CliRunner().invoke(slam, [name, "--help"])
    assert result.exit_code == 0
    module = f"slam_bringup.commands.{name}" if name in COMMANDS else REGISTERED[name][0]
    assert importlib.import_module(module).command.help


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Makes an environment in which no other package registers commands, but for those in the folders given."""

    def only(*folders: Path) -> None:
        others = [p for p in sys.path if not list(Path(p).glob("slam_experiments*-info"))]
        monkeypatch.setattr(sys, "path", [*others, *map(str, folders)])
        registered_commands.cache_clear()

    yield only
    registered_commands.cache_clear()


def test_commands_of_installed_packages_are_listed() -> None:
    text = CliRunner().invoke(slam, ["--help"]).output
    assert [name for name in (*COMMANDS, *REGISTERED) if not re.search(rf"^  {name} ", text, re.MULTILINE)] == []


@pytest.mark.parametrize("name", REGISTERED)
def test_without_its_package_a_command_says_what_to_install(name: str, packages: Callable[..., None]) -> None:
    packages()
    with pytest.raises(ValueError, match="slam_experiments, which is not installed"):
        CliRunner().invoke(slam, [name, "x"], catch_exceptions=False)
    assert name not in CliRunner().invoke(slam, ["--help"]).output.split()
    assert name in CliRunner().invoke(slam, [name[:-1]]).output.partition("Did you mean")[2]


def test_another_package_registers_a_command(packages: Callable[..., None], tmp_path: Path) -> None:
    info = tmp_path / "greeting-1.0.dist-info"
    info.mkdir()
    (info / "entry_points.txt").write_text(
        "[console_scripts]\nx = a:b\n\n[slam.commands]\ngreeting = greeting:TABLE\ngone = no_such_module:TABLE\n"
        "\n[y]\nz = a:b\n"
    )
    (tmp_path / "greeting.py").write_text(
        "import click\nTABLE = {'greet': ('greeting', 'says hello')}\n"
        "@click.command()\ndef command():\n    click.echo('hello')\n"
    )
    packages(tmp_path)
    assert CliRunner().invoke(slam, ["greet"]).output == "hello\n"
    assert "says hello" in CliRunner().invoke(slam, ["--help"]).output
    assert "Did you mean greet?" in CliRunner().invoke(slam, ["gret"]).output
