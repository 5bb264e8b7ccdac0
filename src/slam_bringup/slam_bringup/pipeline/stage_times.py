# SPDX-License-Identifier: Apache-2.0
"""Times of every stage: for the report only, no estimator sees them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")


class StageTimes:
    """Milliseconds of every call of every stage, in order."""

    def __init__(self) -> None:
        self.ms: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Time the block as one call of ``stage``."""
        start = time.perf_counter()
        yield
        self.ms[stage].append(1e3 * (time.perf_counter() - start))

    def each(self, stage: str, items: Iterator[T]) -> Iterator[T]:
        """The items, the making of each timed as one call of ``stage``."""
        while True:
            start = time.perf_counter()
            try:
                item = next(items)
            except StopIteration:
                return
            self.ms[stage].append(1e3 * (time.perf_counter() - start))
            yield item
