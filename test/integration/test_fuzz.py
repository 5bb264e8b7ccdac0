# SPDX-License-Identifier: Apache-2.0
"""A part of ``benchmarks/ros/fuzz.py``: random messages end no node, and the map stays as it was."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "ros"))

MESSAGES = 1500


def test_random_messages_end_no_node_and_change_no_map(tmp_path: Path, domain: int) -> None:
    import fuzz

    outcome, same = fuzz.run(MESSAGES, domain, tmp_path)
    assert same
    for name, o in outcome.items():
        assert o.alive, (tmp_path / f"{name}.log").read_text()[-3000:]
        assert o.faults == 0, (tmp_path / f"{name}.log").read_text()[-3000:]
        assert o.rejected > 0, f"{name} has rejected nothing"
        assert o.grown_mib < 200.0
