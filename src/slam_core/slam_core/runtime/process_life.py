# SPDX-License-Identifier: Apache-2.0
"""End of a process: with the one that started it, and by the signals that ask for it."""

from __future__ import annotations

import atexit
import ctypes
import faulthandler
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

STARTED_S = time.monotonic()
"""Start of this program; whoever measures it imports this module first."""

_FOR = ContextVar[tuple[tuple[str, ...], float] | None]("slam_works_for", default=None)
"""Arguments of the command that this process works for and when it began to, where that is not its own command."""

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has ended."""

PARENT = "SLAM_PARENT_PID"
"""Environment variable with the process that started this one and without which it is of no use."""

_PR_SET_PDEATHSIG = 1
_ORPHAN_ENDS_S = 10.0
"""Longest that a process whose starter has died takes to end, as long as a starter that lives waits for it."""
_parent: list[int] = []
"""The process that this one ends with, once it is known."""

_Handler = Callable[[int, FrameType | None], None]


@contextmanager
def working_for(arguments: Sequence[str]) -> Iterator[None]:
    """Work for the command ``arguments`` of another process from here to the end of the block, as a worker does."""
    token = _FOR.set((tuple(arguments), time.monotonic()))
    try:
        yield
    finally:
        _FOR.reset(token)


def command_line() -> str:
    """The command that this process works for, as a user types it."""
    other = _FOR.get()
    return shlex.join(["slam", *(sys.argv[1:] if other is None else other[0])])


def seconds_since_start() -> float:
    """Time since that command, or a worker's part of it, has begun, s."""
    other = _FOR.get()
    return time.monotonic() - (STARTED_S if other is None else other[1])


def end_with_parent() -> None:
    """Have the kernel send SIGTERM when the process named by :data:`PARENT` ends, however it does (Linux).

    What does not end by itself within ten seconds of that writes where each thread stands to its log and is ended.
    Nobody is left to do it from outside.

    Raises
    ------
    ValueError
        If it has ended already.
    """
    parent = os.environ.pop(PARENT, "")
    if not parent:
        return
    _parent[:] = [int(parent)]
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if _is_orphan():
        raise ValueError(f"the process {parent} that started this node has ended")


def _is_orphan() -> bool:
    return bool(_parent) and os.getppid() != _parent[0]


def on_request_to_end(handler: _Handler) -> dict[signal.Signals, object]:
    """Install ``handler`` for SIGINT, SIGTERM and SIGHUP; returns what was there before.

    A hang-up that is ignored stays so: that is what ``nohup`` asks for. While Python ends all are ignored: a terminal
    and ``ros2 launch`` each send one, and the second would kill a process that has put its handler away.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in numbers])

    def handle(number: int, frame: FrameType | None) -> None:
        if _is_orphan():
            faulthandler.dump_traceback_later(_ORPHAN_ENDS_S, exit=True)
        handler(number, frame)

    return {number: signal.signal(number, handle) for number in numbers}
