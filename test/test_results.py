# SPDX-License-Identifier: Apache-2.0
"""docs/results.md and docs/others.md show what commands printed, and nothing else in figures."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("results", ROOT / "benchmarks/house/results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["results"] = module
    spec.loader.exec_module(module)
    return module


results = load()
PAGES = {path.name: path.read_text(encoding="utf-8") for path in results.PAGES}
BLOCKS = [block for page in PAGES.values() for block in results.blocks(page)]


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_every_figure_of_the_page_was_printed(page):
    assert len(list(results.blocks(page))) == page.count("<!-- measured:") == page.count("```console") > 0
    assert "\n|" not in page, "a table that no command printed"


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.command[:60])
def test_nobody_wrote_into_a_block(block):
    assert block.digest == block.own_digest, f"run benchmarks/house/results.py --run '{block.command}'"
    for script in re.findall(r"benchmarks/[\w/]+\.py", block.command):
        assert (ROOT / script).exists(), script


def test_a_block_that_is_run_again_takes_the_place_of_the_old_one():
    command = f"{sys.executable} -c 'print(6 * 7)'"
    old = results.Block(command, "41\n", "2026-01-01", "0000000", "1", "")
    other = results.Block("echo other", "other\n", "2026-01-01", "0000000", "1", "")
    page = f"before\n\n{old}\nbetween\n\n{other}\nafter\n"
    assert [b.digest == b.own_digest for b in results.blocks(page)] == [True, True]
    anew = results.with_block(page, results.measured(command))
    assert [b.output for b in results.blocks(anew)] == ["42\n", "other\n"]
    assert anew.startswith("before\n\n")
    assert anew.endswith("after\n")


def test_a_figure_changed_by_hand_is_seen():
    block = results.Block("echo 1", "1\n", "2026-01-01", "0000000", "1", "")
    (read,) = results.blocks(str(block).replace("\n1\n", "\n2\n"))
    assert read.digest != read.own_digest
    assert replace(read, output="1\n").own_digest == read.digest
