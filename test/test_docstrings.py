# SPDX-License-Identifier: Apache-2.0
"""A docstring says by itself what it describes: its first words name the thing, and its parentheses close."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parent.parent / "src"
RIDDLE = re.compile(r"(The same|Those|These|Of|And|Likewise|Some of them)\b")
HALF_OPEN = re.compile(r"\[[^\[\]()]*\)")


def described(code: str) -> Iterator[tuple[int, str]]:
    """Line and first paragraph of every docstring."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text.split("\n\n")[0].replace("\n", " ")


def is_riddle(paragraph: str) -> bool:
    plain = HALF_OPEN.sub("", paragraph)
    sentences = re.split(r"(?<=[.:;])\s+", paragraph)[:2]
    return plain.count("(") != plain.count(")") or any(RIDDLE.match(s) for s in sentences)


def test_docstrings_are_no_riddles() -> None:
    texts = ((p, *d) for p in sorted(SRC.rglob("*.py")) for d in described(p.read_text(encoding="utf-8")))
    assert [f"{p.relative_to(SRC)}:{line}: {text}" for p, line, text in texts if is_riddle(text)] == []


@pytest.mark.parametrize(
    "text", ["The same of a picture.", "Share of matches (near one.", "A map. Of poses that stay."]
)
def test_a_riddle_is_found(text: str) -> None:
    assert is_riddle(text)
    assert not is_riddle("Angles (rad) in [-pi, pi).")
