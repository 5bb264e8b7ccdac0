"""How long every stage takes: for the report only, no estimator sees it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


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
