# SPDX-License-Identifier: Apache-2.0
"""The parameter reference in docs/ says what the code says."""

from __future__ import annotations

from pathlib import Path

from slam_bringup.parameter_reference import reference

PAGE = Path(__file__).resolve().parents[2] / "docs" / "parameters.md"


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == reference(), (
        "run: python -m slam_bringup.parameter_reference > docs/parameters.md"
    )
