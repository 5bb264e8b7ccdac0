# SPDX-License-Identifier: Apache-2.0
"""Pages name commands, options, files and figures that exist."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

import indoor_slam
from slam_bringup.cli import slam

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "bags/README.md", *(ROOT / "docs").rglob("*.md")])
SCRIPT_ONLY = {"demo", "test", "setup"}
"""What the script ./slam does itself."""


def command_lines(page: Path) -> list[str]:
    """Lines of code blocks that call slam, without comments."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    lines = [line.split("  #")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if re.match(r"(\./)?slam ", line)]


LINES = [(page, line) for page in PAGES for line in command_lines(page)]


@pytest.mark.parametrize(("page", "line"), LINES, ids=lambda v: v.name if isinstance(v, Path) else v[:50])
def test_every_command_has_these_options(page, line):
    name, *arguments = shlex.split(line)[1:]
    if name in SCRIPT_ONLY:
        return
    command = slam.get_command(click.Context(slam), name)
    assert command is not None, f"{page}: no command {name}"
    while isinstance(command, click.Group):
        command, arguments = command.get_command(click.Context(command), arguments[0]), arguments[1:]
        assert command is not None, f"{page}: {line}"
    command.make_parser(click.Context(command)).parse_args(list(arguments))  # raises on an unknown option


@pytest.mark.slow
def test_the_tutorial_runs_as_typed_and_writes_the_files_that_it_names(tutorial):
    assert set(command_lines(ROOT / "docs/tutorial.md")) == {path.read_text() for path in tutorial.glob("*.run")}
    named = re.findall(r"^\| (`.*?) \|", (ROOT / "docs/tutorial.md").read_text(), flags=re.M)
    for file in re.findall(r"`([^`]+)`", " ".join(named)):
        assert (tutorial / "out/tutorial" / file).exists(), file


def test_the_container_takes_what_is_there():
    """Every file that the Dockerfile copies exists, and what it calls is what ./slam knows."""
    steps = (ROOT / "Dockerfile").read_text()
    for sources in re.findall(r"^COPY (?:--\S+ )*(.*) \S+$", steps, flags=re.M):
        for name in sources.split():
            assert (ROOT / name).exists(), name
    calls = set(re.findall(r"\./slam (\w+)", steps))
    assert calls == {"setup"}


def test_there_are_commands_to_check():
    assert len(LINES) > 15


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert re.match(r"https?:", target) or (page.parent / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_scripts_that_pages_name_exist(page):
    text = page.read_text(encoding="utf-8")
    for script in re.findall(r"\b((?:benchmarks|test)/[\w/]+\.(?:py|yaml|cpp))", text):
        assert (ROOT / script).exists(), f"{page}: {script}"
    for module in re.findall(r"python -m (slam_[\w.]+)", text):
        assert importlib.util.find_spec(module) is not None, f"{page}: {module}"


def test_the_site_builds_without_warnings(tmp_path):
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed (requirements-dev.txt)")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "nodes" / "index.html").exists()
    library = (tmp_path / "library" / "index.html").read_text(encoding="utf-8")
    assert [name for name in indoor_slam.__all__ if f'id="indoor_slam.{name}"' not in library] == []
    assert ":class:" not in library
