# SPDX-License-Identifier: Apache-2.0
"""``slam warmup``: compiles all kernels once, so that no first run and no node has to wait for it.

Three processes compile what scan odometry, features, and filter, map and dense model need, each on the same bag. The
last takes features of OpenCV, so that it does not wait for SURF's kernels. A run of everything compiles the rest.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import replace
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Lock
from pathlib import Path
from typing import Any

import click
from numba.core.caching import Cache

from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.commands.console import progress_bar
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes

_LOOK_S = 0.2
"""Seconds between looks at how far the processes are."""
_seen: Synchronized[int]
"""Readings that all processes have seen."""


@click.command()
@click.argument("bag", type=click.Path(exists=True, path_type=Path))
def command(bag: Path) -> None:
    """Map BAG, which should have stereo, ToF and a loop (bags/demo), for the sake of the compiler's cache alone."""
    with SensorBag(bag) as opened:
        readings = sum(opened.count(agent, role) for agent in opened.agents for role in ("left", "depth", "imu"))
    context = multiprocessing.get_context("spawn")
    seen = context.Value("q", 0)
    parts: tuple[Callable[[Path], None], ...] = (_scans, _features, _map)
    with progress_bar() as progress:
        task = progress.add_task("compiling kernels", total=6 * readings)
        with ProcessPoolExecutor(len(parts), context, _begin, (seen, context.Lock())) as pool:
            waiting = {pool.submit(part, bag) for part in parts}
            while waiting:
                done, waiting = wait(waiting, _LOOK_S)
                for part in done:
                    part.result()
                progress.update(task, completed=seen.value)
        config = choose(load_system_config(None), "fuse", "sjsam", "ndt")
        run_bag(bag, config, odometry="ndt", on_reading=lambda: progress.advance(task))
        progress.update(task, completed=6 * readings)


def _begin(seen: Synchronized[int], alone: Lock) -> None:
    """Begin a process: what it compiles is written while no other process writes.

    Numba names the file of a kernel by the number of its variants: two processes would give two variants one name.
    """
    global _seen
    _seen = seen
    save: Any = Cache.save_overload

    def save_alone(cache: Any, signature: Any, data: Any) -> None:
        with alone:
            save(cache, signature, data)

    Cache.save_overload = save_alone  # type: ignore[method-assign]


def _count() -> None:
    with _seen.get_lock():
        _seen.value += 1


def _scans(bag: Path) -> None:
    """The depth camera and scan odometry."""
    _front_ends(bag, "tof", odometry=True, measures=False)


def _features(bag: Path) -> None:
    """Features and their depth by both cameras."""
    _front_ends(bag, "fuse", odometry=False, measures=True)


def _front_ends(bag: Path, mode: str, *, odometry: bool, measures: bool) -> None:
    config = choose(load_system_config(None), mode, "sjsam", "ndt" if odometry else "none")
    with SensorBag(bag) as opened:
        pipelines = {a: SensorPipeline(config, opened.sensors[a], odometry, StageTimes()) for a in opened.agents}
        for reading in opened.readings():
            for item in pipelines[reading.agent].add(reading):
                if measures:
                    pipelines[reading.agent].measure(item)
            _count()


def _map(bag: Path) -> None:
    """Filter, map and dense model, and the tracks of stereo features."""
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    features = replace(config.feature_extractor.features, detector="sift")
    config = replace(config, feature_extractor=replace(config.feature_extractor, features=features))
    run_bag(bag, config, on_reading=_count)
