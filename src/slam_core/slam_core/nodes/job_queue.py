# SPDX-License-Identifier: Apache-2.0
"""The work that waits in a node, and what is left out when it comes faster than it is done.

``all`` keeps every job in the order of arrival: for a replay, whose player waits. ``newest`` keeps the newest jobs of
each source, so that a live node is never further behind than these; what is left out is counted.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass

POLICIES = ("newest", "all")
_AT_ONCE_S = 0.005
"""Longest time after which another job is begun without looking for messages."""


@dataclass(frozen=True, eq=False)
class QueuedCall:
    """``run`` does the work; ``skip`` is called instead where it is left out, None for what is never left out."""

    source: str
    run: Callable[[], None]
    skip: Callable[[], None] | None = None

    @property
    def is_frame(self) -> bool:
        """True if it may be left out."""
        return self.skip is not None


class JobQueue:
    """Jobs in the order of arrival; may be filled by several threads and emptied by one.

    Parameters
    ----------
    policy
        One of :data:`POLICIES`.
    waiting
        With ``newest``: jobs of a source that may wait.
    """

    def __init__(self, policy: str = "newest", waiting: int = 1) -> None:
        if policy not in POLICIES or waiting < 1:
            raise ValueError(f"jobs need a policy of {', '.join(POLICIES)} and room for one, got {policy}, {waiting}")
        self._policy = policy
        self._limits: defaultdict[str, int] = defaultdict(lambda: waiting)
        self._jobs: deque[QueuedCall] = deque()
        self._lock = threading.Lock()
        self.skipped: Counter[str] = Counter()
        """Jobs left out, by source."""

    def limit(self, source: str, waiting: int) -> None:
        """Let so many jobs of a source wait."""
        self._limits[source] = waiting

    def add(self, job: QueuedCall) -> None:
        """Take a job; leaves out the oldest of its source where more wait than may."""
        surplus: QueuedCall | None = None
        with self._lock:
            self._jobs.append(job)
            if job.is_frame and self._policy == "newest":
                surplus = self._surplus(job.source)
        if surplus is not None and surplus.skip is not None:
            surplus.skip()

    def has_ready(self, *, frames: bool = True) -> bool:
        """True if a job can be done; ``frames``: frames can be begun."""
        with self._lock:
            return bool(self._jobs) and (frames or not self._jobs[0].is_frame)

    def has_frames_of(self, source: str) -> bool:
        """True if a frame of a source waits."""
        with self._lock:
            return any(job.source == source and job.is_frame for job in self._jobs)

    def run_some(self, *, frames: bool = True) -> bool:
        """Do the oldest jobs up to the first frame, or for a while; False if there are none.

        What accompanies frames is many and takes little: readings of an IMU. Without ``frames`` none is begun.
        """
        started, done = time.monotonic(), False
        while (job := self._next(frames)) is not None:
            job.run()
            done = True
            if job.is_frame or time.monotonic() > started + _AT_ONCE_S:
                break
        return done

    def _next(self, frames: bool) -> QueuedCall | None:
        with self._lock:
            return self._jobs.popleft() if self._jobs and (frames or not self._jobs[0].is_frame) else None

    def clear(self) -> None:
        """Forget all that waits."""
        with self._lock:
            self._jobs.clear()

    def _surplus(self, source: str) -> QueuedCall | None:
        same = [job for job in self._jobs if job.source == source and job.is_frame]
        if len(same) <= self._limits[source]:
            return None
        self._jobs.remove(same[0])
        self.skipped[source] += 1
        return same[0]
