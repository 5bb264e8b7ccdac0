# SPDX-License-Identifier: Apache-2.0
"""Runs the jobs of experiments: here, on several processes, or on a Dask cluster whose scheduler's address is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from slam_experiments.job import Job, JobResult, execute, in_order, load


def run_jobs(
    jobs: Sequence[Job],
    cache: Path,
    workers: int = 1,
    scheduler: str | None = None,
    on_done: Callable[[Job], None] = lambda job: None,
) -> dict[Job, JobResult]:
    """Results of all jobs, from the cache where they are kept there.

    Parameters
    ----------
    jobs
        What is wanted; what they build on is run before them.
    cache
        Folder of the results. With ``scheduler`` every worker must see it under the same path.
    workers
        Processes on this machine; 1 runs everything in this process.
    scheduler
        Address of a Dask scheduler ("tcp://host:8786"), instead of processes here.
    on_done
        Called with each job that is finished.
    """
    cache = cache.resolve()
    cache.mkdir(parents=True, exist_ok=True)
    ordered = in_order(jobs)
    if workers == 1 and scheduler is None:
        for job in ordered:
            execute(job, cache)
            on_done(job)
    else:
        _run_distributed(ordered, cache, workers, scheduler, on_done)
    return {job: load(job.folder(cache)) for job in jobs}


def _run_distributed(
    ordered: list[Job], cache: Path, workers: int, scheduler: str | None, on_done: Callable[[Job], None]
) -> None:
    from distributed import Client, as_completed  # a second to import, and needed here alone

    here = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    client: Any = Client(scheduler) if scheduler else Client(**here, memory_limit=0)  # type: ignore[no-untyped-call]
    with client:
        futures: dict[str, Any] = {}
        for job in ordered:
            waited_for = [futures[earlier.digest] for earlier in job.after]
            futures[job.digest] = client.submit(_execute_after, job, cache, waited_for, pure=False)
        by_key = {future.key: job for job, future in zip(ordered, futures.values(), strict=True)}
        for future in as_completed(list(futures.values())):  # type: ignore[no-untyped-call]
            future.result()  # raises what the job raised
            on_done(by_key[future.key])


def _execute_after(job: Job, cache: Path, earlier: list[Path]) -> Path:
    """``earlier`` makes Dask run the jobs before this one; their folders are known without it."""
    del earlier
    return execute(job, cache)
