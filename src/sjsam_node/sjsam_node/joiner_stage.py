# SPDX-License-Identifier: Apache-2.0
"""The stage that joins: one thread alone writes the map, submap after submap, and between two what else is asked for.

Whoever hands something over goes on at once. So a node answers and publishes from the last estimate, however long
joining takes and however many submaps wait; and no filter of an offline run waits for the map, which it does not need.
"""

from __future__ import annotations

import itertools
import threading
import types
from collections.abc import Callable, Generator
from concurrent.futures import Future
from queue import PriorityQueue
from typing import Any, TypeVar

T = TypeVar("T")
_STOP, _REQUEST, _SUBMAP, _LATER, _END = range(5)
"""Priorities of what waits, the first one first."""


class JoinerStage:
    """Does what it is given, on one thread; the future of each task holds what it returns or raises.

    Attributes
    ----------
    received
        Number of submaps that were handed over.
    waiting_at_most
        Largest number of them that waited at once.
    """

    def __init__(self) -> None:
        self._tasks = PriorityQueue[tuple[int, int, Callable[[], None]]]()
        self._number = itertools.count()
        self._submaps: list[Future[Any]] = []
        self.received = self.waiting_at_most = 0
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name="joining", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of submaps that are not joined yet, the one at hand included."""
        self._submaps = [future for future in self._submaps if not future.done()]
        return len(self._submaps)

    def join(self, task: Callable[[], T]) -> Future[T]:
        """Join a submap when all before it are joined."""
        future = self._put(_SUBMAP, task)
        self._submaps.append(future)
        self.received += 1
        self.waiting_at_most = max(self.waiting_at_most, self.waiting)
        return future

    def ask(self, task: Callable[[], T]) -> Future[T]:
        """Do something as soon as the submap at hand is joined, however many wait."""
        return self._put(_REQUEST, task)

    def when_idle(self, task: Callable[[], None] = lambda: None) -> Future[None]:
        """A future that is done when nothing waits any more and a last task is done."""
        return self._put(_LATER, task)

    def close(self) -> None:
        """Do all that waits and end the thread."""
        self._put(_END, self._end)
        self._thread.join()

    def stop(self) -> None:
        """End the thread after the submap it is at; what waits is left undone."""
        self._put(_STOP, self._end)
        self._thread.join()

    def _put(self, priority: int, task: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()

        def run() -> None:
            try:
                result = task()
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        self._tasks.put((priority, next(self._number), run))
        return future

    def _end(self) -> None:
        self._is_open = False

    def _run(self) -> None:
        while self._is_open:
            self._tasks.get()[2]()


@types.coroutine
def result_of(future: Future[T]) -> Generator[None, None, T]:
    """Await what another thread does in a callback of rclpy, whose executor goes on with all else."""
    while not future.done():
        yield
    return future.result()
