# SPDX-License-Identifier: Apache-2.0
"""Output of the commands on the terminal (``-q``, ``-v``), and the log that a run leaves in its folder.

The packages log by Python's ``logging``. On the terminal stands what the chosen verbosity lets through; a
:class:`Transcript` keeps everything, for ``OUT/logs/slam.log``.
"""

from __future__ import annotations

import io
import logging
import platform
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from slam_core.runtime.process_life import STARTED_S, command_line
from slam_core.storage.files import atomic_text

LOG_NAME = "slam.log"
"""The log of a run, in the folder of logs beside its results."""

_VERBOSITY, _HANDLER = "slam.verbosity", "slam.handler"
_LEVELS = (logging.ERROR, logging.WARNING, logging.INFO, logging.DEBUG)
_FOREIGN = ("matplotlib", "numba", "PIL", "trimesh", "websockets", "asyncio", "viser", "distributed", "tornado")
"""Libraries whose own messages help nobody here."""


def with_verbosity(command: click.Command) -> click.Command:
    """The command with the options ``-q`` and ``-v``, which it then has once."""
    if any(option.name == "verbose" for option in command.params):
        return command
    command.params += [
        click.Option(["-q", "--quiet"], is_flag=True, expose_value=False, callback=_quieter, help="print errors only"),
        click.Option(
            ["-v", "--verbose"], count=True, expose_value=False, callback=_louder, help="print more; -vv: everything"
        ),
    ]
    return command


def is_quiet() -> bool:
    """True if only errors are wanted."""
    return _verbosity() < 0


def show(table: Any) -> None:
    """Print the result of a command for a person, unless only errors are wanted.

    Its texts come from recordings: brackets in them are no markup.
    """
    if not is_quiet():
        Console(markup=False).print(table)


def progress_bar() -> Progress:
    """A bar with rate and remaining time, on standard error, so that standard output holds the result alone.

    Lines that ``-v`` prints take its place.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    return Progress(*columns, console=Console(stderr=True), disable=_verbosity() != 0)


def log_to_terminal(context: click.Context) -> None:
    """Print what the packages log, as far as it is wanted, on standard error, until the command has ended."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Elapsed("%(elapsed)8.2f s  %(message)s"))
    context.meta[_HANDLER] = handler
    _set(context, _verbosity())
    _attach(handler)
    context.call_on_close(lambda: logging.getLogger().removeHandler(handler))


class _Rate(ProgressColumn):
    """Steps per second."""

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else f"{task.speed:.1f}/s", style="progress.data.speed")


class Transcript:
    """Keeps all that is logged in a ``with`` block, for :meth:`write`."""

    def __init__(self, version: str) -> None:
        self._lines = [
            f"slam {version}, Python {platform.python_version()}, {platform.platform()}",
            f"command: {command_line()}",
            time.strftime("started: %Y-%m-%d %H:%M:%S %z"),
        ]
        self._handler = _Keeper(self._lines)

    def __enter__(self) -> Self:
        _attach(self._handler)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        logging.getLogger().removeHandler(self._handler)

    def write(self, path: Path, table: Table) -> None:
        """Write everything kept so far, and the table that the run ends with."""
        with io.StringIO() as text:
            Console(file=text, width=120, markup=False).print(table)
            lines = [*self._lines, text.getvalue()]
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_text(path, "\n".join(lines))


class _Elapsed(logging.Formatter):
    """Knows the time since the program has started as ``%(elapsed)``."""

    def format(self, record: logging.LogRecord) -> str:
        record.elapsed = time.monotonic() - STARTED_S
        return super().format(record)


class _Keeper(logging.Handler):
    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.DEBUG)
        self._lines = lines
        self.setFormatter(_Elapsed("%(elapsed)8.2f s  %(levelname)-7s %(name)s: %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append(self.format(record))


def _attach(handler: logging.Handler) -> None:
    handler.addFilter(lambda record: record.name.partition(".")[0] not in _FOREIGN)
    logging.getLogger().addHandler(handler)
    logging.getLogger().setLevel(logging.DEBUG)


def _verbosity() -> int:
    """-1: errors alone; 0; 1 and 2: more."""
    context = click.get_current_context(silent=True)
    return 0 if context is None else int(context.find_root().meta.get(_VERBOSITY, 0))


def _quieter(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked:
        _set(context, -1)


def _louder(context: click.Context, _: click.Parameter, count: int) -> None:
    if count:
        _set(context, count)


def _set(context: click.Context, verbosity: int) -> None:
    meta = context.find_root().meta
    meta[_VERBOSITY] = verbosity
    if _HANDLER in meta:
        meta[_HANDLER].setLevel(_LEVELS[min(verbosity, 2) + 1])
