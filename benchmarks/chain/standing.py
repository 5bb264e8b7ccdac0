# SPDX-License-Identifier: Apache-2.0
"""A rig that stands: one stereo pair again and again with fresh sensor noise, which must move and map nothing.

    python benchmarks/chain/standing.py BAG [--seconds 14] [--rate 10] [--noise 2] [--pair N]

BAG: a recording with stereo pairs, EuRoC MH_01 say (``slam convert euroc FOLDER -o BAG``); its pair N is repeated, with
Gaussian noise of so many grey levels. Prints how far the filter and the joined map move, which should be below 1 mm,
and how many submaps and landmarks there are at the end.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.reading.readings import StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, SensorWriter
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.types import ByteArray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--seconds", type=float, default=14.0)
    parser.add_argument("--rate", type=float, default=10.0, help="pairs per second")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation, grey levels")
    parser.add_argument("--pair", type=int, default=0, help="number of the pair that is repeated")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        standing = Path(folder) / "standing.mcap"
        frames = round(arguments.seconds * arguments.rate)
        repeat(arguments.bag, standing, arguments.pair, frames, arguments.rate, arguments.noise)
        config = choose(load_system_config(None), "stereo", "sjsam", "none", "off")
        config = replace(config, dense_mapper=replace(config.dense_mapper, use_stereo=False, use_tof=False))
        result, _ = run_bag(standing, config)
    agent = result.agents[0]
    table = Table(title=f"pair {arguments.pair} of {arguments.bag.name}, {frames} times")
    for heading in ("filter moves mm, deg", "map moves mm, deg", "submaps", "landmarks", "frames seen standing"):
        table.add_column(heading)
    moves = [_largest_move(trajectory.poses) for trajectory in (agent.filtered, agent.trajectory)]
    landmarks = len(result.landmarks.positions)
    table.add_row(*moves, str(result.submaps), str(landmarks), str(result.rejections.get("frames_standing", 0)))
    Console(width=120).print(table)


def repeat(source: Path, target: Path, number: int, frames: int, rate: float, noise: float) -> None:
    """A bag of one pair of another, ``frames`` times at ``rate`` (Hz), with fresh noise (grey levels)."""
    rng = np.random.default_rng(0)
    with SensorBag(source) as bag, BagWriter(target) as writer:
        sensors = bag.sensors[bag.agents[0]]
        pairs = (reading.pair for reading in bag.readings() if isinstance(reading, StereoReading))
        pair = next(p for k, p in enumerate(pairs) if k == number)
        infos = (sensors.left, sensors.right)
        out = SensorWriter(writer)
        T_base_left = sensors.transform("base", "left")
        T_left_right = np.eye(4)
        T_left_right[0, 3] = sensors.right.baseline
        out.extrinsics(pair.stamp_ns, {LEFT_FRAME: T_base_left, RIGHT_FRAME: T_base_left @ T_left_right})
        for k in range(frames):
            stamp_ns = pair.stamp_ns + round(k / rate * 1e9)
            out.stereo(stamp_ns, _noisy(pair.left, noise, rng), _noisy(pair.right, noise, rng), infos)


def _noisy(picture: ByteArray, noise: float, rng: np.random.Generator) -> ByteArray:
    return np.clip(np.rint(picture + noise * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)


def _largest_move(poses: np.ndarray) -> str:
    """Farthest place and largest turn from the first pose."""
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], poses[0, :3, :3]) - 1.0) / 2.0
    turn = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max())
    return f"{1e3 * np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max():.2f}, {turn:.3f}"


if __name__ == "__main__":
    main()
