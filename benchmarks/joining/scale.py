# SPDX-License-Identifier: Apache-2.0
"""Joining as a tree of tasks at scale: agents in a generated campus, one process against Dask's workers.

    python benchmarks/joining/scale.py [--agents 100] [--submaps 100] [--workers 1 2 4] [--no-reference]

One Gauss-Newton step and all covariances. Printed: difference to one factor of the whole (unless --no-reference),
processor milliseconds per submap, memory, bytes between tasks; with workers, wall time and efficiency from Dask's task
stream; for 16 and 64 workers what the recorded tasks and their dependencies would take (a list schedule with
``--overhead`` per task), and the critical path.
"""

from __future__ import annotations

import argparse
import heapq
import pickle
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from campus import campus

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from sjsam_node.regions.fronts import Front
from sjsam_node.regions.pieces import Eliminated
from sjsam_node.regions.tasks import InProcess, OnCluster, Tasks
from sjsam_node.regions.tree import RegionTree
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray

Problem = tuple[FlatMaps, JoiningState, IntArray]


@dataclass
class Recorded:
    """Runs tasks here, and records what each took (s), what it waited for, and the bytes of its result."""

    seconds: list[float] = field(default_factory=list)
    after: list[list[int]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    passed: int = 0

    def hold(self, value: Any) -> Any:
        """The value itself."""
        return value

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Run a function, and record it."""
        values = [a.value if isinstance(a, _Handle) else a for a in arguments]
        began = time.process_time()
        result = function(*values)
        self.seconds.append(time.process_time() - began)
        self.after.append([a.number for a in arguments if isinstance(a, _Handle)])
        self.names.append(getattr(function, "__name__", "part"))
        if not isinstance(result, (Eliminated, Front, tuple)):
            self.passed += len(pickle.dumps(result, protocol=5))
        return _Handle(len(self.seconds) - 1, result)

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results."""
        return [h.value for h in handles]

    def critical_path(self) -> float:
        """Longest chain of tasks, s."""
        end = list[float]()
        for seconds, after in zip(self.seconds, self.after, strict=True):
            end.append(seconds + max((end[k] for k in after), default=0.0))
        return max(end)

    def makespan(self, workers: int, overhead: float) -> float:
        """Time of a list schedule, the task with the longest chain behind it first, s."""
        count = len(self.seconds)
        following: list[list[int]] = [[] for _ in range(count)]
        for k, after in enumerate(self.after):
            for before in after:
                following[before].append(k)
        left = [0.0] * count
        for k in reversed(range(count)):
            left[k] = self.seconds[k] + overhead + max((left[j] for j in following[k]), default=0.0)
        waiting, ready = (
            [len(after) for after in self.after],
            [(-left[k], k) for k in range(count) if not self.after[k]],
        )
        heapq.heapify(ready)
        running: list[tuple[float, int]] = []
        now = 0.0
        while ready or running:
            while ready and len(running) < workers:
                _, k = heapq.heappop(ready)
                heapq.heappush(running, (now + self.seconds[k] + overhead, k))
            now, k = heapq.heappop(running)
            for j in following[k]:
                waiting[j] -= 1
                if not waiting[j]:
                    heapq.heappush(ready, (-left[j], j))
        return now


@dataclass(frozen=True)
class _Handle:
    number: int
    value: Any


def solve(problem: Problem, tasks: Tasks) -> tuple[RegionTree, FloatArray, FloatArray, FloatArray]:
    """One step, and the covariances of all poses and landmarks."""
    maps, state, fixed = problem
    tree = RegionTree(maps, state, fixed, kernels.TANGENT, tasks)
    tree.eliminate(state)
    return tree, tree.step(), *tree.covariances()


def compare(problem: Problem, tree: RegionTree, step: FloatArray, poses: FloatArray, landmarks: FloatArray) -> None:
    """Difference to one factor of the whole problem."""
    maps, state, fixed = problem
    began = time.process_time()
    whole = JoiningProblem(maps, state, fixed, kernels.TANGENT)
    newton, _ = whole.newton_step(state)
    marginals = whole.marginals(state)
    one = marginals.pose_blocks(np.arange(len(poses))), marginals.landmark_blocks(np.arange(len(landmarks)))
    seconds = time.process_time() - began
    tree_pose, tree_landmark = tree.offsets
    worst = 0.0
    for mine, theirs, size in (
        (tree_pose, whole.layout.pose_offset, 6),
        (tree_landmark, whole.layout.landmark_offset, 3),
    ):
        free = mine >= 0
        a, b = (step[mine[free][:, None] + np.arange(size)], newton[theirs[free][:, None] + np.arange(size)])
        worst = max(worst, float(np.abs(a - b).max()) / float(np.abs(b).max()))
    covariance = max(
        float((np.abs(mine - known).max(axis=(1, 2)) / np.maximum(np.abs(known).max(axis=(1, 2)), 1e-300)).max())
        for mine, known in ((poses[1:], one[0][1:]), (landmarks, one[1]))
    )
    count = len(maps.reference)
    print(f"  one factor: {1e3 * seconds / count:.2f} ms of processor time per submap; "
          f"largest relative difference: mean {worst:.1e}, covariance {covariance:.1e}")  # fmt: skip


def on_workers(problem: Problem, workers: int) -> None:
    """The same on Dask's workers: wall time, and efficiency from the task stream."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as local,
        Client(local) as client,
    ):
        solve(problem, OnCluster(client))  # what is compiled and loaded
        with_stream = client.get_task_stream()
        first = len(with_stream)
        began = time.perf_counter()
        solve(problem, OnCluster(client))
        wall = time.perf_counter() - began
        stream = client.get_task_stream()[first:]
        memory = max(client.run(_peak_mib).values())
    busy = [(s["start"], s["stop"]) for task in stream for s in task["startstops"] if s["action"] == "compute"]
    span = max(stop for _, stop in busy) - min(start for start, _ in busy)
    efficiency = sum(stop - start for start, stop in busy) / (workers * span)
    count = len(problem[0].reference)
    print(f"  {workers} workers: {wall:.1f} s wall ({1e3 * wall / count:.2f} ms per submap), tasks {len(stream)}, "
          f"efficiency {efficiency:.2f}, largest worker {memory:.0f} MiB")  # fmt: skip


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=100)
    parser.add_argument("--submaps", type=int, default=100)
    parser.add_argument("--workers", type=int, nargs="*", default=[])
    parser.add_argument("--overhead", type=float, default=1e-3, help="of the engine per task, s")
    parser.add_argument("--no-reference", action="store_true")
    arguments = parser.parse_args()
    solve(campus(4, 40), InProcess())  # compiles
    began = time.process_time()
    problem = campus(arguments.agents, arguments.submaps)
    count = len(problem[0].reference)
    print(f"{arguments.agents} agents x {arguments.submaps} submaps: {count} local maps, "
          f"{len(problem[1].landmarks)} landmarks, generated in {time.process_time() - began:.1f} s")  # fmt: skip
    before, began, recorded = _peak_mib(), time.process_time(), Recorded()
    found = solve(problem, recorded)
    seconds = time.process_time() - began
    sizes = [len(region.variables) for region in found[0].root.regions()]
    print(f"  tree: {1e3 * seconds / count:.2f} ms of processor time per submap, "
          f"{1e3 * sum(recorded.seconds) / count:.2f} of them in {len(recorded.seconds)} tasks; "
          f"largest front {max(sizes)} variables; "
          f"{recorded.passed / count / 1024:.1f} KiB between tasks per submap; peak {_peak_mib():.0f} MiB "
          f"({before:.0f} before)")  # fmt: skip
    if not arguments.no_reference:
        compare(problem, *found)
    path, total = recorded.critical_path(), sum(recorded.seconds) + arguments.overhead * len(recorded.seconds)
    print(f"  critical path {path:.2f} s of {sum(recorded.seconds):.1f} s")
    for workers in (1, 2, 4, 16, 64):
        span = recorded.makespan(workers, arguments.overhead)
        print(f"  schedule on {workers:3d} workers: {span:6.2f} s, efficiency {total / workers / span:.2f}")
    for workers in arguments.workers:
        on_workers(problem, workers)


if __name__ == "__main__":
    main()
