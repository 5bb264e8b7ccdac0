# SPDX-License-Identifier: Apache-2.0
"""What waits is done in order; a live queue never holds more frames of a source than it may."""

from __future__ import annotations

import pytest

from slam_core.nodes.job_queue import JobQueue, QueuedCall


def fill(queue: JobQueue, count: int = 5) -> tuple[list[str], list[str]]:
    """Frames a0, a1, ... with something after each that must not be left out; what is done and what left out."""
    done: list[str] = []
    left_out: list[str] = []
    for k in range(count):
        name = f"a{k}"
        queue.add(QueuedCall("a", lambda n=name: done.append(n), lambda n=name: left_out.append(n)))  # type: ignore[misc]
        queue.add(QueuedCall("imu", lambda n=name: done.append(f"imu after {n}")))  # type: ignore[misc]
    while queue.run_some():
        pass
    return done, left_out


def test_a_replay_keeps_everything_in_order() -> None:
    done, left_out = fill(JobQueue("all"))
    assert done == [f"{prefix}a{k}" for k in range(5) for prefix in ("", "imu after ")]
    assert left_out == []


def test_a_live_queue_keeps_the_newest_frames_and_all_that_is_no_frame() -> None:
    queue = JobQueue("newest", waiting=2)
    done, left_out = fill(queue)
    assert [name for name in done if not name.startswith("imu")] == ["a3", "a4"]
    assert len(done) == 7
    assert left_out == ["a0", "a1", "a2"]
    assert queue.skipped == {"a": 3}


def test_sources_do_not_push_each_other_out() -> None:
    queue, done = JobQueue("newest", waiting=1), []
    for name in ("a0", "b0", "a1"):
        queue.add(QueuedCall(name[0], lambda n=name: done.append(n), lambda: None))
    while queue.run_some():
        pass
    assert done == ["b0", "a1"]


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(ValueError, match="newest, all"):
        JobQueue("oldest")
