# SPDX-License-Identifier: Apache-2.0
"""Format, lint and types of the whole tree, as pyproject.toml asks for them."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("command", ["ruff format --check .", "ruff check .", "mypy"])
def test_the_tree_is_clean(command):
    tool, *arguments = command.split()
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed")
    done = subprocess.run(
        [sys.executable, "-m", tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


def summaries(path: Path) -> list[str]:
    """Summary lines of all docstrings of a file, those of constants and attributes too, as ``file:line: text``."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {node.value.value.strip().splitlines()[0]}")
    return found


PACKAGES = {path.name for path in (ROOT / "src").iterdir() if path.is_dir()}


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_a_summary_says_what_is_returned_or_done_and_asks_no_question(package):
    lines = [line for path in (ROOT / "src" / package).rglob("*.py") for line in summaries(path)]
    assert lines
    questions = [line for line in lines if re.search(r":\d+: (What|Whether|Which|Where|When|Who|Why|How)\b", line)]
    assert not questions, "\n".join(questions)


def test_the_long_tests_are_tests_that_there_are():
    for line in (ROOT / "test" / "long_tests.txt").read_text(encoding="utf-8").splitlines():
        path, _, name = line.partition("::")
        name = re.split(r"[\[]", name.rpartition("::")[2])[0]
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), f"{line}: remove it from long_tests.txt"
