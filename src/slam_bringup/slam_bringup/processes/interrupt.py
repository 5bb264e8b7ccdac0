"""Ctrl-C as a wish: a long run ends early and keeps what it has, instead of losing it."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any, Self

import click

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has ended."""

STOPPED = "stopped before the end of the bag"
"""What a result says of a run that ended early."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """Within the ``with`` block the first SIGINT or SIGTERM sets :attr:`asked`; the second raises KeyboardInterrupt."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        click.echo("\nstopping: what is mapped so far will be written; once more to give it up", err=True)
