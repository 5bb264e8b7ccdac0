# SPDX-License-Identifier: Apache-2.0
"""One ``slam run`` that also says what CPU time each stage took; ``cost.py`` starts it with a checkout in PYTHONPATH.

    python benchmarks/chain/cost_of_run.py JSON BAG -o OUT [OPTION of slam run ...]

A stage's time is that of its own thread and of what it hands to helping threads, so work beside it does not count.
"""

from __future__ import annotations

import gc
import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slam_bringup.cli import slam

try:
    from slam_bringup.pipeline.stage_times import StageTimes
except ImportError:  # of version 0.1
    from slam_bringup.stage_times import StageTimes
try:
    from sjsam_node.session.map_session import MapSession
except ImportError:  # joining was measured as the other stages are
    MapSession = None  # type: ignore[assignment,misc]

_AFTER_MAPPING = "dense model"


class StageCpu:
    """CPU seconds of every stage, and of the whole process when mapping began and ended."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.began: float | None = None
        self.mapped: float | None = None
        self._here = threading.local()
        self._measure, self._submit = StageTimes.measure, ThreadPoolExecutor.submit

    @contextmanager
    def measure(self, times: StageTimes, stage: str) -> Iterator[None]:
        """In place of ``StageTimes.measure``."""
        self.began = time.process_time() if self.began is None else self.began
        if stage == _AFTER_MAPPING and self.mapped is None:
            self.mapped = time.process_time()
        self._here.stage, start = stage, time.thread_time()
        with self._measure(times, stage):
            yield
        self.seconds[stage] += time.thread_time() - start
        self._here.stage = None

    def each(self, times: StageTimes, stage: str, items: Iterator[Any]) -> Iterator[Any]:
        """In place of ``StageTimes.each``; the attempt that finds nothing ready counts as well."""
        nothing = object()
        while True:
            self.began = time.process_time() if self.began is None else self.began
            self._here.stage, start = stage, time.thread_time()
            began = time.perf_counter()
            item = next(items, nothing)
            wall_s = time.perf_counter() - began
            self.seconds[stage] += time.thread_time() - start
            self._here.stage = None
            if item is nothing:
                return
            times.ms[stage].append(1e3 * wall_s)
            yield item

    def join(self, join: Callable[..., Any], *args: Any) -> Any:
        """In place of the session's method that joins a submap."""
        with self.measure(StageTimes(), "sjsam"):
            return join(*args)

    def submit(self, pool: ThreadPoolExecutor, work: Callable[..., Any], *args: Any, **named: Any) -> Future[Any]:
        """In place of ``ThreadPoolExecutor.submit``: the work counts for the stage that asked for it."""
        stage = getattr(self._here, "stage", None)

        def timed() -> Any:
            start = time.thread_time()
            try:
                return work(*args, **named)
            finally:
                if stage is not None:
                    self.seconds[stage] += time.thread_time() - start

        return self._submit(pool, timed)


def peak_mib() -> float:
    """Peak memory of this program alone: what ``wait4`` tells begins with that of the process that started it."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(lines["VmHWM"].split()[0]) / 1024.0


def main() -> None:
    gc.disable()  # as slam does while modules are loaded
    target, *arguments = sys.argv[1:]
    cpu = StageCpu()
    StageTimes.measure = lambda times, stage: cpu.measure(times, stage)  # type: ignore[method-assign,assignment]
    StageTimes.each = lambda times, stage, items: cpu.each(times, stage, items)  # type: ignore[attr-defined,method-assign,assignment]
    ThreadPoolExecutor.submit = lambda pool, *a, **k: cpu.submit(pool, *a, **k)  # type: ignore[method-assign,assignment]
    if MapSession is not None:
        add = MapSession._add
        MapSession._add = lambda *a: cpu.join(add, *a)  # type: ignore[method-assign]
    slam(["run", *arguments], standalone_mode=False)
    mapped = time.process_time() if cpu.mapped is None else cpu.mapped
    report = {
        "stages": cpu.seconds, "mapping": mapped - (cpu.began or 0.0), "before": cpu.began, "peak_mib": peak_mib(),
    }  # fmt: skip
    Path(target).write_text(json.dumps(report))


if __name__ == "__main__":
    main()
