# SPDX-License-Identifier: Apache-2.0
"""``slam warmup``: its processes run to their end, and each says how far it is."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest
from click.testing import CliRunner
from numba.core.caching import Cache

from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.cli import slam
from slam_bringup.commands import warmup

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


@pytest.mark.slow
def test_all_parts_see_the_whole_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cache, "save_overload", Cache.save_overload)
    seen = multiprocessing.Value("q", 0)
    warmup._begin(seen, multiprocessing.Lock())
    with SensorBag(DEMO) as opened:
        readings = sum(1 for _ in opened.readings())
    for part, times in ((warmup._scans, 1), (warmup._features, 1), (warmup._map, 2)):
        before = seen.value
        part(DEMO)
        assert seen.value - before == times * readings


def test_a_kernel_is_written_while_nobody_else_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = multiprocessing.Lock()
    held: list[bool] = []
    monkeypatch.setattr(Cache, "save_overload", lambda *_: held.append(not alone.acquire(block=False)))
    warmup._begin(multiprocessing.Value("q", 0), alone)
    Cache.save_overload(None, None, None)
    assert held == [True]
    assert alone.acquire(block=False), "released afterwards"


def test_a_bag_that_is_none_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(slam, ["warmup", str(tmp_path)])
    assert result.exit_code != 0
