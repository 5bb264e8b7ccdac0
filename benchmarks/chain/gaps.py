# SPDX-License-Identifier: Apache-2.0
"""What gaps do to a map: frames of all cameras are left out, as a machine that cannot keep up leaves them out.

    python benchmarks/chain/gaps.py BAG [--mode fuse --odometry ndt]

BAG: a simulated bag with IMU and ground truth (``slam simulate workshop_rig --profile ideal -o BAG``). Rows: the frames
that are there, with and without the IMU: ATE and ANEES of the joined map, its parts (1 if it is whole), how many gaps
the IMU had to carry the rig across, and frames lost. A map may become less exact by gaps, but must not claim what it
does not know: ANEES stays near 1.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag

_HEADINGS = ("frames there are", "IMU", "frames", "map: ATE mm", "ANEES", "parts", "gaps crossed", "frames lost")
_SETTLED_S = 4.0
"""Nothing is left out before."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--mode", default="stereo")
    parser.add_argument("--odometry", default="none")
    arguments = parser.parse_args()
    table = Table(title=f"{arguments.bag.name}, {arguments.mode}, odometry {arguments.odometry}")
    for heading in _HEADINGS:
        table.add_column(heading)
    with tempfile.TemporaryDirectory() as scratch:
        for k, (name, is_kept) in enumerate(_patterns()):
            bag = Path(scratch) / f"{k}.mcap"
            thin(arguments.bag, bag, is_kept)
            for imu in ("off", "on"):
                table.add_row(name, imu, *row(bag, arguments.mode, arguments.odometry, imu))
    Console(width=130).print(table)


def _patterns() -> list[tuple[str, Callable[[float], bool]]]:
    """Names, and whether the frames of a time (s since the first) are kept."""
    bursts = [(0.5, 0.7), (0.4, 1.2), (0.4, 2.5), (1.0, 3.5)]
    periodic = [(f"{on:g} s, then {off:g} s without", _bursts(on, off)) for on, off in bursts]
    return [("all", lambda time: True), *periodic, *((f"{p:.0%}, at random", _random(p)) for p in (0.3, 0.15))]


def _bursts(on: float, off: float) -> Callable[[float], bool]:
    # Half a frame away from the frames' own times.
    return lambda time: time < _SETTLED_S or (time - _SETTLED_S + 0.05) % (on + off) < on


def _random(share: float) -> Callable[[float], bool]:
    drawn = np.random.default_rng(2).random(10_000)
    return lambda time: time < _SETTLED_S or bool(drawn[round(10.0 * time)] < share)


def thin(source: Path, target: Path, is_kept: Callable[[float], bool]) -> None:
    """Copy a bag without the pictures of the times (s since the first of them) that are not kept."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        types = {topic: info.type_name for topic, info in reader.topics.items()}
        pictures = [topic for topic, kind in types.items() if kind.endswith(("Image", "CompressedImage"))]
        first = next(message.stamp_ns for message in reader.raw(pictures))
        for topic, stamp_ns, data in reader.raw():
            if topic not in pictures or is_kept((stamp_ns - first) * 1e-9):
                writer.write_raw(topic, types[topic], data, stamp_ns)


def row(bag: Path, mode: str, odometry: str, imu: str) -> list[str]:
    """One run of ``slam run``'s pipeline, without a dense model."""
    config = choose(load_system_config(None), mode, "sjsam", odometry, imu)
    config = replace(config, dense_mapper=replace(config.dense_mapper, use_stereo=False, use_tof=False))
    result, session = run_bag(bag, config, odometry=odometry)
    e = result.agents[0].evaluation()
    assert e is not None
    counts = result.rejections
    return [
        str(result.frames), f"{1e3 * e.ate.rmse:.1f}", f"{e.anees or np.nan:.2f}", str(session.snapshot.components),
        str(counts.get("gaps_bridged", 0)), str(counts.get("frames_lost", 0)),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
