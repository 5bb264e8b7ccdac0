# SPDX-License-Identifier: Apache-2.0
"""What holds for every command."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from slam_bringup.cli import COMMANDS, VERSION, slam

SOURCES = Path(__file__).resolve().parents[2] / "src"


def test_the_version_is_that_of_the_packages() -> None:
    assert VERSION in CliRunner().invoke(slam, ["--version"]).output
    for package in SOURCES.glob("*/package.xml"):
        assert re.search(r"<version>(.*)</version>", package.read_text())[1] == VERSION, package


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_help(name: str) -> None:
    result = CliRunner().invoke(slam, [name, "--help"])
    assert result.exit_code == 0
    assert importlib.import_module(f"slam_bringup.commands.{name}").command.help
