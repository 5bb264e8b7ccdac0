# SPDX-License-Identifier: Apache-2.0
"""What holds for every command."""

from __future__ import annotations

import importlib
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from slam_bringup.cli import COMMANDS, VERSION, slam
from slam_bringup.commands.console import progress_bar, show

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


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_help(name: str) -> None:
    result = CliRunner().invoke(slam, [name, "--help"])
    assert result.exit_code == 0
    assert importlib.import_module(f"slam_bringup.commands.{name}").command.help
