# SPDX-License-Identifier: Apache-2.0
"""The work that waits in a node, and what is left out when it comes faster than it is done.

``all`` keeps every job in the order of arrival: for a replay, whose player waits. ``newest`` keeps the newest jobs of
each source, so that a live node is never further behind than these; what is left out is counted.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

POLICIES = ("newest", "all")


@dataclass(frozen=True, eq=False)
class QueuedCall:
    """``run`` does the work; ``skip`` is called instead where it is left out, None for what is never left out."""

    source: str
    run: Callable[[], None]
    skip: Callable[[], None] | None = None


class JobQueue:
    """Jobs in the order of arrival; may be filled by several threads and emptied by one.

    Parameters
    ----------
    policy
        One of :data:`POLICIES`.
    waiting
        With ``newest``: jobs of a source that may wait.
    """

    def __init__(self, policy: str = "newest", waiting: int = 2) -> None:
        if policy not in POLICIES or waiting < 1:
            raise ValueError(f"jobs need a policy of {', '.join(POLICIES)} and room for one, got {policy}, {waiting}")
        self._policy = policy
        self._limit = waiting
        self._jobs: deque[QueuedCall] = deque()
        self._lock = threading.Lock()
        self.skipped: Counter[str] = Counter()
        """Jobs left out, by source."""

    def __len__(self) -> int:
        return len(self._jobs)

    def add(self, job: QueuedCall) -> None:
        """Take a job; leaves out the oldest of its source where more wait than may."""
        surplus: QueuedCall | None = None
        with self._lock:
            self._jobs.append(job)
            if job.skip is not None and self._policy == "newest":
                surplus = self._surplus(job.source)
        if surplus is not None and surplus.skip is not None:
            surplus.skip()

    def run_one(self) -> bool:
        """Do the oldest job; False if there is none."""
        with self._lock:
            if not self._jobs:
                return False
            job = self._jobs.popleft()
        job.run()
        return True

    def clear(self) -> None:
        """Forget all that waits."""
        with self._lock:
            self._jobs.clear()

    def _surplus(self, source: str) -> QueuedCall | None:
        same = [job for job in self._jobs if job.source == source and job.skip is not None]
        if len(same) <= self._limit:
            return None
        self._jobs.remove(same[0])
        self.skipped[source] += 1
        return same[0]
