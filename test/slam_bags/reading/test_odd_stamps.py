# SPDX-License-Identifier: Apache-2.0
"""Copies of the demo with odd stamps: what is odd is left out and told, all else is mapped."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mapping import mapped
from slam_bags.storage.bag import BagReader, BagWriter
from slam_viewer.results import summarise

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
HOUR_S = 3600


def copy(target: Path, change: Callable[[str, int, Any], list[Any]]) -> Path:
    """The demo with other messages; ``change`` gets topic, number on the topic and message."""
    numbers: dict[str, int] = {}
    with BagReader(DEMO) as old, BagWriter(target) as new:
        for topic, stamp, message in old.messages():
            number = numbers[topic] = numbers.get(topic, -1) + 1
            for item in change(topic, number, message):
                new.write(topic, item, stamp)
    return target


def ahead(which: int) -> Callable[[str, int, Any], list[Any]]:
    def change(topic: str, number: int, message: Any) -> list[Any]:
        if number == which and "image_raw" in topic:
            message.header.stamp.sec += HOUR_S
        return [message]

    return change


@pytest.mark.slow
@pytest.mark.parametrize("which", [25, 0])
def test_one_frame_stamped_an_hour_ahead_costs_that_frame_alone(tmp_path: Path, which: int) -> None:
    summary = summarise(mapped(copy(tmp_path / "bag", ahead(which))))
    assert summary["frames"] in (51, 51 + (which == 0))
    assert summary["ate_rmse_m"] < 0.03
    odd = {reason for reason in summary["dropped_by_reason"] if "stamps off their stream" in reason}
    assert bool(odd) == (which > 0)
    told = "3600" if which else "a new session begins"
    assert any(told in event for event in summary["events"]), summary["events"]


@pytest.mark.slow
def test_every_frame_twice_is_a_duplicate_and_mapped_once(tmp_path: Path) -> None:
    def twice(topic: str, number: int, message: Any) -> list[Any]:
        return [message] * (2 if "image_raw" in topic and "stereo" in topic else 1)

    summary = summarise(mapped(copy(tmp_path / "bag", twice)))
    assert summary["frames"] == 52
    assert summary["dropped_by_reason"] == {
        f"duplicate stamps on /stereo/{side}/image_raw/compressed": 52 for side in ("left", "right")
    }


def refocused(first: int) -> Callable[[str, int, Any], list[Any]]:
    """Focal length x 1.3 from a frame on."""

    def change(topic: str, number: int, message: Any) -> list[Any]:
        if number >= first and "stereo" in topic and "camera_info" in topic:
            message.k = message.k * [1.3, 1, 1, 1, 1.3, 1, 1, 1, 1]
            message.p = message.p * [1.3, 1, 1, 1.3, 1, 1.3, 1, 1, 1, 1, 1, 1]
        return [message]

    return change


@pytest.mark.slow
def test_frames_under_another_calibration_are_left_out_and_told(tmp_path: Path) -> None:
    summary = summarise(mapped(copy(tmp_path / "bag", refocused(40))))
    assert summary["frames"] == 40
    assert sum(n for reason, n in summary["dropped_by_reason"].items() if "another calibration" in reason) == 12
    assert any("has changed (fx" in event for event in summary["events"])
    assert (summary["state"], summary["degraded"]) == ("OK", [])


@pytest.mark.slow
def test_a_run_that_lost_most_frames_says_so_in_one_line_and_ends_with_a_code_of_its_own(tmp_path: Path) -> None:
    bag, out = copy(tmp_path / "bag", refocused(10)), tmp_path / "out"
    command = [sys.executable, "-m", "slam_bringup.cli", "-q", "run", str(bag), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    assert "DEGRADED: 81% of the messages" in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["state"] == "DEGRADED"
    assert "another calibration" in summary["degraded"][0]
