# SPDX-License-Identifier: Apache-2.0
"""Submaps of many agents, replayed to one map as they would come: how long each waits until the map has it.

    python benchmarks/joining/live.py [--agents 100] [--submaps 6] [--rate 10] [--workers 2 [--kill-after 0.5]]

Agents walk through the campus of ``campus.py``, each from a place of its own; their submaps of a metre come in turn,
``--rate`` of them a second. Printed: the time from a submap's arrival to the map that has it (median, 95 %, longest),
processor time of this process a submap, closures, parts, and a digest of the map. ``--workers``: comparisons and old
submaps go to a Dask scheduler and so many workers of this machine; ``--kill-after`` kills one of these (signal 9) after
that share of the submaps, and prints the time until all that had come by then are in the map. ``--unpaced``: each is
joined as soon as the one before is, and the waiting is that of a queue of their processor times: what a machine without
other work would show.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import problems  # noqa: F401 - sets the import path
from campus import BLOCK_M, VISITS, landmarks_on_walls, walk
from submap_world import Agent, World, path_through

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.map_file import storage
from sjsam_node.regions.live import LiveTasks
from sjsam_node.session.map_session import MapSession
from slam_core.geometry import FloatArray
from slam_core.types import Submap

_WARM_UP = 12
"""Submaps that are joined before, for what is compiled and loaded."""


def submaps_in_turn(agents: int, each: int, seed: int = 0) -> list[Submap]:
    """Submaps of all agents in turn, a second apart."""
    rng = np.random.default_rng(seed)
    n = max(1, round(np.sqrt(agents * each / VISITS / (2 * BLOCK_M))))
    world = World.random(landmarks_on_walls(n, rng), rng)
    walks = [Agent(world, _path(n, each, rng), rng, f"agent_{k:04d}").submaps() for k in range(agents)]
    out = []
    for turn in range(each):
        for k, own in enumerate(walks):
            began = 10**9 * (turn * agents + k)
            out.append(replace(own[turn], start_stamp_ns=began + 1, end_stamp_ns=began + 10**9))
    return out


def _path(n: int, metres: int, rng: np.random.Generator) -> list[FloatArray]:
    """Poses of a walk of so many metres at least, four a metre."""
    places, _ = walk(n, metres + 2, rng)
    turns = [at for before, at, after in zip(places, places[1:], places[2:], strict=False)
             if (np.subtract(at, before) != np.subtract(after, at)).any()]  # fmt: skip
    return path_through([(float(x), float(y)) for x, y in (places[0], *turns, places[-1])])


def replay(
    submaps: list[Submap], session: MapSession, rate: float, at: int, do: Callable[[], None]
) -> tuple[list[float], list[int], float]:
    """Seconds until the map had each submap, closures of each, and seconds from ``do`` at a submap until it was in."""
    began, done_at, futures = time.perf_counter(), dict[int, float](), []
    done = 0.0
    for k, submap in enumerate(submaps):
        time.sleep(max(0.0, began + k / rate - time.perf_counter()))
        if k == at:
            do()
            done = time.perf_counter()
        future = session.add(submap)
        future.add_done_callback(lambda _, k=k: done_at.setdefault(k, time.perf_counter()))
        futures.append(future)
    closures = [0 if (outcome := future.result()) is None else outcome.closures for future in futures]
    waited = [done_at[k] - began - k / rate for k in range(len(submaps))]
    return waited, closures, done_at[at] - done if done else 0.0


def queued(submaps: list[Submap], rate: float) -> tuple[list[float], list[int], GlobalMap]:
    """The same from processor times: seconds until the map had each submap, closures of each; the map."""
    joined, waited, closures, free_at = GlobalMap(), list[float](), list[int](), 0.0
    for k, submap in enumerate(submaps):
        began = time.process_time()
        closures.append(len(joined.add(submap).closures))
        free_at = max(free_at, k / rate) + time.process_time() - began
        waited.append(free_at - k / rate)
    return waited, closures, joined


def digest(joined: GlobalMap) -> str:
    packed = storage.pack(joined.stored())
    content = hashlib.sha256(repr(packed.manifest).encode())
    for name, value in sorted(packed.arrays.items()):
        content.update(name.encode() + value.tobytes())
    return content.hexdigest()[:12]


def report(
    arguments: argparse.Namespace, submaps: list[Submap], waited: list[float], closures: list[int], used: float,
    joined: GlobalMap,
) -> None:  # fmt: skip
    """Print what a replay took and gave."""
    landmarks = np.mean([len(s.landmarks) for s in submaps])
    print(f"{arguments.agents} agents, {len(submaps)} submaps of {landmarks:.0f} landmarks, {arguments.rate:g} a s, "
          f"{arguments.workers} workers{', by processor time' * arguments.unpaced}")  # fmt: skip
    print(f"  submap to map: median {np.median(waited):.2f} s, 95 % {np.percentile(waited, 95):.2f} s, longest "
          f"{max(waited):.2f} s; {1e3 * used / len(submaps):.0f} ms of processor time of this process a submap; "
          f"{sum(closures)} closures, {joined.components} parts, map {digest(joined)}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=100)
    parser.add_argument("--submaps", type=int, default=6)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--kill-after", type=float)
    parser.add_argument("--unpaced", action="store_true")
    arguments = parser.parse_args()
    submaps = submaps_in_turn(arguments.agents, arguments.submaps)
    warm = GlobalMap()
    for submap in submaps[:_WARM_UP]:
        warm.add(submap)
    if arguments.unpaced:
        used = time.process_time()
        waited, closures, joined = queued(submaps, arguments.rate)
        used = time.process_time() - used
        report(arguments, submaps, waited, closures, used, joined)
        return
    with ExitStack() as stack:
        tasks, kill = None, lambda: None
        if arguments.workers:
            from dask_cluster import running_cluster

            own = stack.enter_context(running_cluster(arguments.workers))
            tasks, kill = LiveTasks(own.address), own.kill_worker
        session = stack.enter_context(MapSession(GlobalMapConfig(), tasks=tasks))
        share, used = arguments.kill_after, time.process_time()
        at = len(submaps) if share is None else int(share * len(submaps))
        waited, closures, since = replay(submaps, session, arguments.rate, at, kill)
        used = time.process_time() - used
        report(arguments, submaps, waited, closures, used, session._map)
        counts = session.load_counts
    if tasks is not None:
        print(f"  {counts['tasks elsewhere']} tasks on the cluster, {counts['tasks here']} here in its place")
    if since:
        print(f"  a worker was killed: {since:.2f} s until the map had what had come by then")


if __name__ == "__main__":
    main()
