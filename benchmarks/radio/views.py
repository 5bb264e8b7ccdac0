# SPDX-License-Identifier: Apache-2.0
"""Bytes and processor time of the pictures and dense key frames that an agent keeps for a post.

    python benchmarks/radio/views.py BAG ... [--every 10]

Every so many images of each camera are encoded with the defaults of ``views.*``, whatever the way between them.
Prints for each bag and kind the number, the bytes (median and largest), the pieces of a median one with the headers
that the budget counts, the seconds that they take on 20 kB/s, and the processor time of one.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from slam_bags.reading.readings import AgentSensors, DepthReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.sensor_pipeline import depth_stage
from slam_core.types import PoseEstimate, Submap
from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.views.view_config import ViewConfig
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_format import KINDS
from slam_radio.views.view_taker import ViewTaker
from slam_radio.wire.view_messages import pack_piece, pieces_of

_RATE = 20000.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    parser.add_argument("--every", type=int, default=10)
    arguments = parser.parse_args()
    for path in arguments.bags:
        with SensorBag(path) as bag, tempfile.TemporaryDirectory() as folder:
            measure(path, bag, Path(folder), arguments.every)


def measure(path: Path, bag: SensorBag, folder: Path, every: int) -> None:
    files = ViewFiles(folder / "views", 1e9)
    taker = ViewTaker(ViewConfig(), files)
    stages = {agent: depth_stage(SystemConfig(), sensors) for agent, sensors in bag.sensors.items()}
    seen: dict[tuple[str, type], int] = defaultdict(int)
    times = []
    for reading in bag.readings():
        if not isinstance(reading, StereoReading | DepthReading):
            continue
        seen[reading.agent, type(reading)] += 1
        if seen[reading.agent, type(reading)] % every:
            continue
        images = []
        if isinstance(reading, DepthReading):
            stages[reading.agent].add(reading.raw)
            images = list(stages[reading.agent].ready())
        start = time.process_time()
        take(taker, reading, images, bag.sensors[reading.agent])
        times.append(time.process_time() - start)
    sizes: dict[str, list[int]] = defaultdict(list)
    wire: dict[str, list[int]] = defaultdict(list)
    for key in files.sizes:
        _, data = files.read(key)
        sizes[KINDS[key.kind]].append(len(data))
        wire[KINDS[key.kind]].append(sum(len(pack_piece(p)) + OVERHEAD for p in pieces_of(key, key.stamp_ns, data)))
    for kind, found in sizes.items():
        print(f"{path.name}: {len(found)} of kind {kind}, {np.median(found):.0f} bytes (most {max(found)}), "
              f"{np.median(wire[kind]):.0f} on the wire, {np.median(wire[kind]) / _RATE:.1f} s at 20 kB/s")  # fmt: skip
    print(f"{path.name}: {1e3 * np.median(times):.1f} ms of processor time an image")


def take(taker: ViewTaker, reading: StereoReading | DepthReading, images: list, sensors: AgentSensors) -> None:
    """Encode and keep the images of a reading, in a submap of their own."""
    if isinstance(reading, StereoReading):
        taker.add_picture(reading.stamp_ns, np.eye(4), colours(reading.pair.picture()), None)
    for image in images:
        taker.add_depth(image, np.eye(4), None)
    stamp = reading.stamp_ns
    path = (PoseEstimate(stamp, np.eye(4), np.eye(6)),)
    none = np.empty((0, 3))
    taker.end_submap(
        Submap("", 0, stamp, stamp, np.eye(4), none, np.eye(6), np.empty(0, dtype=np.int64),
               np.empty(0, dtype=np.int32), np.empty((0, 64), dtype=np.float32), path)
    )  # fmt: skip


def colours(picture: np.ndarray) -> np.ndarray:
    return picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)


if __name__ == "__main__":
    main()
