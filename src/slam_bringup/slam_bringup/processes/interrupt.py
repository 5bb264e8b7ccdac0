# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C as a wish: a long run ends early and keeps what it has, instead of losing it.

So does a terminal that is closed; what the run still has to say then goes nowhere.
"""

from __future__ import annotations

import os
import signal
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

import click

from slam_core.runtime.process_life import INTERRUPTED as INTERRUPTED
from slam_core.runtime.process_life import on_request_to_end
from slam_core.storage.output_folder import OutputFolder

MAP = "map"
"""The part of the results that a user who gives up keeps."""


class Interrupt:
    """Within the ``with`` block the first SIGINT, SIGTERM or SIGHUP sets :attr:`asked`.

    A second SIGINT or SIGTERM raises KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        self._before = dict(on_request_to_end(self._on_signal))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            self.asked = True
            _forget_the_terminal()
            return
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        click.echo("\nstopping: what is mapped so far will be written; once more to keep the map alone", err=True)


@contextmanager
def giving_up(results: OutputFolder) -> Iterator[None]:
    """Tell a user who gives up where the map is, and end the program."""
    try:
        yield
    except KeyboardInterrupt:
        kept = f"the map is in {results.rescued}" if results.rescued else "nothing was mapped yet"
        click.echo(f"given up: {kept}", err=True)
        sys.exit(INTERRUPTED)


def _forget_the_terminal() -> None:
    """Writing to a terminal or a pipe that is gone fails, and must not end what goes on without it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if not stat.S_ISREG(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)
