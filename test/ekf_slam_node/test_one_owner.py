# SPDX-License-Identifier: Apache-2.0
"""The filter has one owner: only the open submap names it, so that only it can change it.

Experiments make filters of their own.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "src"


def uses(code: str) -> list[str]:
    """Names of the filter's class, and attributes that could hold a filter."""
    nodes = list(ast.walk(ast.parse(code)))
    names = [n.name for n in nodes if isinstance(n, ast.alias)] + [n.id for n in nodes if isinstance(n, ast.Name)]
    held = [n.attr for n in nodes if isinstance(n, ast.Attribute) and n.attr in ("ekf", "_ekf")]
    return held + [name for name in names if name == "Ekf"]


def test_the_open_submap_alone_holds_the_filter() -> None:
    files = [p for p in SRC.rglob("*.py") if p.name != "setup.py" and "experiments" not in p.parts]
    assert {p.name for p in files if uses(p.read_text(encoding="utf-8"))} == {"ekf.py", "open_submap.py"}


@pytest.mark.parametrize(
    "code", ["from a.ekf import Ekf", "local._ekf.restart(v)", "x = Ekf(v, P)", "chain.local.ekf.T = T"]
)
def test_a_use_is_found(code: str) -> None:
    assert uses(code)
    assert not uses("config.ekf_slam.agent, ekf_slam")
