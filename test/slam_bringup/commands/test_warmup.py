# SPDX-License-Identifier: Apache-2.0
"""``slam warmup`` maps a bag in every way that needs kernels of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from slam_bringup.cli import slam
from slam_bringup.commands import warmup
from slam_bringup.pipeline.configuration import SystemConfig

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


def test_scans_and_tracks_are_among_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[tuple[bool, str]] = []

    def mapped(bag: Path, config: SystemConfig, *, odometry: str, **_: Any) -> None:
        runs.append((config.feature_extractor.tracks, odometry))

    monkeypatch.setattr(warmup, "run_bag", mapped)
    monkeypatch.setattr(warmup, "compile_listed", lambda on_module, calls: False)
    assert CliRunner().invoke(slam, ["warmup", str(DEMO)]).exit_code == 0
    assert sorted(runs) == [(True, "ndt"), (True, "none")]


def test_nothing_is_mapped_where_the_list_of_calls_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "run_bag", lambda *_, **__: pytest.fail("mapped"))
    monkeypatch.setattr(warmup, "compile_listed", lambda on_module, calls: len(calls) > 20)
    assert CliRunner().invoke(slam, ["warmup", str(DEMO)]).exit_code == 0


def test_a_bag_that_is_none_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(slam, ["warmup", str(tmp_path)])
    assert result.exit_code != 0
