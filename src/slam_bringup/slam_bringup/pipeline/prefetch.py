# SPDX-License-Identifier: Apache-2.0
"""Items made by another thread, a few batches ahead of their use."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from typing import TypeAlias, TypeVar

T = TypeVar("T")
Batches: TypeAlias = queue.Queue[tuple[list[T] | None, BaseException | None]]
IMAGES_AHEAD = 2
"""Batches with images that may wait between two stages: those of a depth camera take 2 to 5 MB."""


def prefetch(items: Generator[T, None, None], ends_batch: Callable[[T], bool], ahead: int) -> Generator[T, None, None]:
    """Items of an iterator, made by another thread up to ``ahead`` batches before their use.

    Handing over wakes threads: IMU samples, ten to a frame, go together with the image that they come before.
    """
    made: Batches[T] = queue.Queue(ahead)
    stopped = threading.Event()
    thread = threading.Thread(target=_fill, args=(made, items, ends_batch, stopped), name="images", daemon=True)
    thread.start()
    try:
        while True:
            ready, error = made.get()
            if error is not None:
                raise error
            if ready is None:
                return
            yield from ready
    finally:
        stopped.set()
        while thread.is_alive():  # it may wait for room; the bag must not be closed under it
            with suppress(queue.Empty):
                made.get(timeout=0.05)


def _fill(
    made: Batches[T], items: Generator[T, None, None], ends_batch: Callable[[T], bool], stopped: threading.Event
) -> None:
    """Put the items into the queue by batches, then None, with the error that has ended them if one has."""
    error: BaseException | None = None
    batch: list[T] = []
    with closing(items):
        try:
            for item in items:
                batch.append(item)
                if not ends_batch(item):
                    continue
                made.put((batch, None))
                batch = []
                if stopped.is_set():
                    return
        except BaseException as caught:  # handed to the consumer, who raises it
            error = caught
    made.put((batch, None))
    made.put((None, error))
