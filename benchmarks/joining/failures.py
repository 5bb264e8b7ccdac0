# SPDX-License-Identifier: Apache-2.0
"""Merges maps on a cluster whose worker is killed, and whose scheduler is killed and started again; counts bytes.

    python benchmarks/joining/failures.py MAP MAP ... [--after 0.3]

MAP: folders that ``slam merge`` takes. The cluster is a scheduler and two workers on this machine. ``--after``: share
of the joining that is done when something is killed. Printed: bytes that go to tasks and come back, per submap and per
closure between maps; the time of an undisturbed merge; of one whose worker is killed (signal 9); and of one whose
scheduler and workers are killed and started again at once. "same" tells that the map has the bytes of a merge in one
process.
"""

from __future__ import annotations

import argparse
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sjsam_node.global_map import GlobalMapConfig
from sjsam_node.map_file import storage
from sjsam_node.merging.merge import Merged, merge
from sjsam_node.merging.union import NamedMap
from sjsam_node.regions.tasks import InProcess, cluster
from slam_bringup.terminal.mapping_options import map_folder


class Counted(InProcess):
    """Runs tasks here, and counts the bytes that would go to workers and come back."""

    held = sent = returned = 0

    def hold(self, value: Any) -> Any:
        """The value; it goes to a worker once."""
        self.held += len(pickle.dumps(value, protocol=5))
        self._known = {*getattr(self, "_known", set()), id(value)}
        return value

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function; what is held is not sent again."""
        new = [a for a in arguments if id(a) not in getattr(self, "_known", set())]
        result = function(*arguments)
        self.sent += len(pickle.dumps(new, protocol=5))
        self.returned += len(pickle.dumps(result, protocol=5))
        return result


class OwnCluster:
    """A scheduler and two workers of this machine, at one address whenever they are started."""

    def __init__(self) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            port = taken.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        worker = ("distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        self._commands = [
            ("distributed.cli.dask_scheduler", "--port", str(port), "--no-dashboard"), worker, worker
        ]  # fmt: skip
        self._running: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start all."""
        self._running = [subprocess.Popen([sys.executable, "-m", *c], stderr=subprocess.DEVNULL)
                         for c in self._commands]  # fmt: skip

    def kill(self, chosen: slice = slice(None)) -> None:
        """Kill some of them with signal 9."""
        for process in self._running[chosen]:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()


def packed(merged: Merged) -> list[bytes]:
    one = storage.pack(merged.map.stored())
    return [repr(one.manifest).encode(), *(value.tobytes() for _, value in sorted(one.arrays.items()))]


def disturbed(maps: Sequence[NamedMap], own: OwnCluster, share: float, disturb: Callable[[], None]) -> tuple[Any, ...]:
    """The map's bytes, the time of the merge, and the time since ``disturb`` was done, s."""
    since: list[float] = []

    def on_step(step: str, done: int, total: int) -> None:
        if not since and step == "joining" and done >= share * total:
            disturb()
            since.append(time.perf_counter())

    began = time.perf_counter()
    with cluster(own.address) as tasks:
        found = packed(merge(maps, GlobalMapConfig(), tasks, on_step))
    end = time.perf_counter()
    return found, end - began, end - since[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", type=Path, nargs="+", metavar="MAP")
    parser.add_argument("--after", type=float, default=0.3)
    arguments = parser.parse_args()
    maps = [NamedMap(str(p), storage.read(map_folder(p, localize_only=False) or p)) for p in arguments.maps]
    counted = Counted()
    one = merge(maps, GlobalMapConfig(), counted)
    expected, submaps = packed(one), len(one.map.state.graph.records)
    began = time.perf_counter()
    merge(maps, GlobalMapConfig(), InProcess())
    print(f"{len(maps)} maps, {submaps} submaps, {one.closures} closures between maps; in one process "
          f"{time.perf_counter() - began:.1f} s")  # fmt: skip
    kib = [n / 1024 for n in (counted.held, counted.sent + counted.returned)]
    print(f"  to workers once {kib[0] / submaps:.0f} KiB per submap; with tasks and back {kib[1] / submaps:.1f} KiB "
          f"per submap, {kib[1] / max(one.closures, 1):.1f} KiB per closure")  # fmt: skip
    own = OwnCluster()
    own.start()
    try:
        _wait(own.address)
        for name, disturb in (
            ("undisturbed", lambda: None),
            ("a worker killed", lambda: own.kill(slice(2, 3))),
            ("all killed and started", lambda: (own.kill(slice(0, 2)), own.start())),
        ):
            found, whole, since = disturbed(maps, own, arguments.after, disturb)
            print(f"  {name}: {whole:.1f} s, {since:.1f} s of them from there on, same: {found == expected}")
    finally:
        own.kill()


def _wait(address: str) -> None:
    from distributed import Client

    with Client(address, timeout=60) as client:
        client.wait_for_workers(2, timeout=60)


if __name__ == "__main__":
    main()
