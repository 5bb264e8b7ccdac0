# SPDX-License-Identifier: Apache-2.0
"""Parts of the demo bag as bags of their own, and commands that are called in this process."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.cli import slam

DEMO = Path(__file__).resolve().parents[1] / "bags" / "demo"


def call(*arguments: object):
    return CliRunner().invoke(slam, [str(a) for a in arguments], catch_exceptions=True)


def cut(path: Path, start: float, end: float, source: Path = DEMO) -> Path:
    """A part of the demo, or of another bag, by share of its time."""
    with BagReader(source) as bag, BagWriter(path) as part:
        for message in bag.raw():
            info, since = bag.topics[message.topic], (message.stamp_ns - bag.start_ns) * 1e-9 / bag.duration_s
            if start <= since <= end or info.count == 1 or "tf" in message.topic:
                part.write_raw(message.topic, info.type_name, message.data, message.stamp_ns)
    return path
