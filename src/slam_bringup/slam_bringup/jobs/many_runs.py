# SPDX-License-Identifier: Apache-2.0
"""``slam run`` on many recordings: each is a task that writes a folder of its own; one that fails stops no other."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from sjsam_node.regions.tasks import TellingTasks
from slam_bringup.jobs.recording_run import RecordingRun, RunOptions, Watch
from slam_core.runtime.process_life import working_for

_TOLD_EVERY_S = 0.5
"""Time between two messages of a task about how far it is."""


@dataclass(frozen=True, eq=False)
class RunOutcome:
    """Summary of one recording, or the reason for which there is none."""

    bag: Path
    output: Path
    summary: dict[str, Any] | None
    failure: str = ""

    @property
    def reason(self) -> str:
        """Reason for which it failed, also half-way; empty where it did not."""
        return self.failure or (str(self.summary["failure"] or "") if self.summary else "")


@dataclass(frozen=True, eq=False)
class RunTask:
    """One recording to map, where, how, and for which command."""

    bag: Path
    output: Path
    options: RunOptions
    arguments: tuple[str, ...]


def folder_names(bags: Sequence[Path]) -> list[str]:
    """The name of each recording's folder: its own, with those of the folders above as far as two are called the same.

    Raises
    ------
    ValueError
        If a recording is named twice.
    """
    paths = [path.resolve() for path in bags]
    if twice := next((path for path in paths if paths.count(path) > 1), None):
        raise ValueError(f"{twice} is named twice")
    parts = [(*p.parts[1:-1], p.stem if p.is_file() else p.name) for p in paths]
    own = dict.fromkeys(range(len(parts)), 1)
    while clashing := _clashing(["_".join(p[-own[k] :]) for k, p in enumerate(parts)]):
        longer = [k for k in clashing if own[k] < len(parts[k])]
        if not longer:
            raise ValueError(f"{paths[clashing[0]]} and {paths[clashing[1]]} would have the same folder of results")
        own |= {k: own[k] + 1 for k in longer}
    return ["_".join(p[-own[k] :]) for k, p in enumerate(parts)]


def _clashing(names: Sequence[str]) -> list[int]:
    return [k for k, name in enumerate(names) if names.count(name) > 1]


def run_many(
    bags: Sequence[Path],
    output: Path,
    options: RunOptions,
    tasks: TellingTasks,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    on_written: Callable[[str], None] = lambda name: None,
) -> list[RunOutcome]:
    """Map recordings, each into the folder of its name in ``output``; in the order in which they are given.

    ``on_progress`` is told how many readings of how many known ones are mapped, ``on_written`` the name of a folder as
    soon as its results are there; both may be called by another thread.
    """
    known, names = dict[int, tuple[int, int]](), folder_names(bags)

    def on_told(value: Any) -> None:
        if len(value) == 1:
            on_written(names[int(value[0])])
            return
        known[int(value[0])] = int(value[1]), int(value[2])
        on_progress(sum(done for done, _ in known.values()), sum(total for _, total in known.values()))

    if options.old_map is not None:  # a worker of a cluster runs in a folder of its own
        options = replace(options, old_map=options.old_map.resolve())
    tell, handles = tasks.channel(on_told), list[tuple[RunTask, Any]]()
    for number, (bag, name) in enumerate(zip(bags, names, strict=True)):
        task = RunTask(bag.resolve(), output.resolve() / name, options, tuple(sys.argv[1:]))
        handles.append((task, tasks.submit(run_task, task, number, tell)))
    outcomes = []
    for task, handle in handles:
        try:
            outcomes += tasks.gather([handle])
        except ValueError as error:  # its worker, or the whole cluster, is lost
            outcomes.append(RunOutcome(task.bag, task.output, None, str(error)))
    return outcomes


def run_task(task: RunTask, number: int, tell: Callable[[Any], None]) -> RunOutcome:
    """Map one recording.

    ``tell`` is given its number, the readings that are done, and all of them, now and then; once its results are
    written, its number alone.
    """
    with working_for(task.arguments):
        try:
            run = RecordingRun(task.bag, task.output, task.options)
            summary, _ = run.write(_Told(number, tell))
        except (ValueError, OSError) as error:
            return RunOutcome(task.bag, task.output, None, str(error) or type(error).__name__)
        except Exception as error:  # a fault of the program stops no other recording
            return RunOutcome(task.bag, task.output, None, f"{type(error).__name__}: {error}")
    tell((number,))
    return RunOutcome(task.bag, task.output, summary)


@dataclass(eq=False)
class _Told:
    """Tells another process how far a run is."""

    number: int
    tell: Callable[[Any], None]
    _done: int = field(default=0, init=False)

    @contextmanager
    def mapping(self, readings: int) -> Iterator[Watch]:
        """Tell at most every :data:`_TOLD_EVERY_S`, and in the end."""
        last = time.monotonic()

        def on_reading() -> None:
            nonlocal last
            self._done += 1
            if time.monotonic() - last > _TOLD_EVERY_S:
                last = time.monotonic()
                self.tell((self.number, self._done, readings))

        self.tell((self.number, 0, readings))
        yield Watch(on_reading, lambda: False)
        self.tell((self.number, readings, readings))

    def writing(self) -> AbstractContextManager[object]:
        """Say nothing."""
        return nullcontext()


def outcomes_table(outcomes: Sequence[RunOutcome]) -> Table:
    """One row for each recording."""
    table = Table(title=f"{len(outcomes)} recordings")
    for name in ("recording", "state", "frames", "lost", "path m", "submaps", "closures", "ATE mm", "mapped in s"):
        table.add_column(name, justify="left" if name in ("recording", "state") else "right")
    for one in outcomes:
        table.add_row(one.output.name, *_row(one))
    return table


def _row(one: RunOutcome) -> list[str]:
    s = one.summary
    if s is None:
        return ["failed"]
    state = "ended early" if one.reason else s["state"]
    lost = f"{max(s['lost_share'].values(), default=0.0):.0%}"
    parts = s.get("agents", {"": s}).values()
    ate = ", ".join(f"{1e3 * p['ate_rmse_m']:.1f}" for p in parts if "ate_rmse_m" in p) or "-"
    return [
        state, str(s["frames"]), lost, f"{s['path_length_m']:.2f}", str(s["submaps"]), str(s["loop_closures"]), ate,
        f"{s['wall_s']:.1f}",
    ]  # fmt: skip
