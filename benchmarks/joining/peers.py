# SPDX-License-Identifier: Apache-2.0
"""Our joining against GTSAM and Ceres on the same problems, in one run: time, chi2, covariances, memory.

    python benchmarks/joining/peers.py [--sizes 34 500 2000] [--repeat 3] [--incremental] [--node]

Every solver runs in a process of its own on the same submaps. Block rows (each landmark with its own 3x3) are what all
of them can express with their own factors; chi2 is our cost function at their solution, so that all are measured
alike. Times are medians; memory is what the process grew by while it solved. "batch" is from chained odometry to the
optimum with everything symbolic, given what each solver reads: flat maps, a factor graph, residual blocks.
"covariances" is the joint covariance of eight poses along the way at the optimum, linearised and factored there.
``--incremental`` adds one submap after the other, with known association: iSAM2 with the estimate after each; ours
placing each on the map at once and joining all of it every 1 + sqrt(n) / 3 submaps, as often as the node looks for
closures. ``--node`` does it as the node does, finding associations and closures itself, of joint rows.

Needs gtsam beside the run-time requirements (a separate environment is best), and for Ceres pyceres 2.4 with pycolmap
3.11, whose compiled residuals it borrows; what is not there is left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from memory import PeakMemory
from problems import KnownProblem, flattened, joining_problem, local_maps, ring

from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import JoiningState, LocalMap
from slam_core.estimation.least_squares import LevenbergMarquardtConfig
from slam_core.geometry import so3_exp
from slam_experiments.linear_slam.block_problem import BlockProblem

STOP = LevenbergMarquardtConfig(relative_tolerance=1e-6)
"""GTSAM stops when the cost falls by less than 1e-5 of itself, Ceres at 1e-6; ours when a step promises less."""

BATCH, INCREMENTAL = ("ours", "gtsam", "ceres", "ours joint"), ("isam2", "ours in turn")


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = action()
    return time.perf_counter() - began, result


def solve_ours(maps: list[LocalMap], state: JoiningState, rows: str, repeat: int) -> dict[str, Any]:
    flat = flattened(maps, rows)

    def run() -> tuple[JoiningProblem | BlockProblem, JoiningState]:
        problem = joining_problem(flat, state)
        return problem, problem.optimize(state, STOP)[0]

    few = joining_problem(flat.first(3), state)  # compiles
    few.columns(few.optimize(state, LevenbergMarquardtConfig(max_iterations=3))[0], np.array([1]))
    memory = PeakMemory()
    seconds, (problem, optimum) = timed(run)
    grown, times = memory.grown(), [seconds]
    for _ in range(repeat - 1):
        seconds, (problem, optimum) = timed(run)
        times.append(seconds)
    poses = np.linspace(1, len(state.translations) - 1, 8).astype(np.int64)
    # A copy of the optimum, so that nothing is taken from the last factor.
    states = [replace(optimum) for _ in range(repeat)]
    covariances = [timed(partial(problem.columns, at, poses))[0] for at in states]
    return {"batch": times, "covariances": covariances, "memory": grown, "state": optimum}


def child(solver: str, path: Path, repeat: int) -> dict[str, Any]:
    """One solver on one problem; the result without its state, judged by our cost."""
    problem: KnownProblem = pickle.loads(path.read_bytes())
    if solver == "ours node":
        return as_node(problem)
    rows = "joint" if solver == "ours joint" else "block"
    maps, state = local_maps(problem, rows, shared_only=rows == "joint")
    if solver == "ours in turn":
        result = in_turn(maps, state)
    elif solver.startswith("ours"):
        result = solve_ours(maps, state, rows, repeat)
    elif solver == "ceres":
        import ceres_peer

        result = ceres_peer.solve(maps, state, repeat)
    else:
        import gtsam_peer

        result = (gtsam_peer.isam2 if solver == "isam2" else gtsam_peer.solve)(maps, state, repeat)
    result["chi2"] = joining_problem(flattened(maps, rows), state).cost(result.pop("state"))
    return result


def in_turn(maps: list[LocalMap], state: JoiningState) -> dict[str, Any]:
    """One submap after the other; poses and landmarks are numbered by first sight, so that a prefix is a problem."""
    compiles = joining_problem(flattened(maps[:3], "block"), state)
    compiles.optimize(state, LevenbergMarquardtConfig(max_iterations=3))
    memory, began = PeakMemory(), time.perf_counter()
    flat = flattened(maps, "block")
    R, t, points, seen, due = state.rotations.copy(), state.translations.copy(), state.landmarks.copy(), 0, 0.0
    for k, m in enumerate(maps):
        R[k + 1], t[k + 1] = R[k] @ so3_exp(m.mean[3:6]), R[k] @ m.mean[:3] + t[k]
        new = m.landmarks >= seen
        points[m.landmarks[new]] = m.mean[6:].reshape(-1, 3)[new] @ R[k].T + t[k]
        seen = max(seen, int(m.landmarks.max()) + 1)
        due += 1.0 / (1.0 + np.sqrt(k) / 3.0)
        if due >= 1.0 or k == len(maps) - 1:
            known, due = JoiningState(R[: k + 2], t[: k + 2], points[:seen]), 0.0
            known = joining_problem(flat.first(k + 1), known).optimize(known, STOP)[0]
            R[: k + 2], t[: k + 2], points[:seen] = known.rotations, known.translations, known.landmarks
    seconds = time.perf_counter() - began
    return {"batch": [seconds], "memory": memory.grown(), "state": JoiningState(R, t, points)}


def as_node(problem: KnownProblem) -> dict[str, Any]:
    """Through GlobalMap, association and closures included; its chi2 is over its own associations."""
    from sjsam_node.global_map import GlobalMap

    warm = GlobalMap()
    for submap in problem.submaps[:20]:
        warm.add(submap)
    memory, global_map = PeakMemory(), GlobalMap()

    def run() -> None:
        for submap in problem.submaps:
            global_map.add(submap)
        global_map.settle()

    seconds, _ = timed(run)
    return {"batch": [seconds], "memory": memory.grown(), "chi2": float("nan")}


def run_child(solver: str, path: Path, repeat: int) -> dict[str, Any] | None:
    command = [sys.executable, __file__, "--child", solver, "--problem", str(path), "--repeat", str(repeat)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"  {solver:18s} failed: {' '.join(done.stderr.rpartition('Error:')[2].split())[:150]}")
        return None
    return dict(json.loads(done.stdout.splitlines()[-1]))


def compare(count: int, solvers: list[str], repeat: int, folder: Path) -> None:
    path = folder / f"{count}.pkl"
    path.write_bytes(pickle.dumps(ring(count)))
    results = {solver: run_child(solver, path, repeat) for solver in solvers}
    print(f"{count} submaps: batch s, chi2, covariances s, MiB; then ours / theirs: time, covariances, memory")
    for solver, result in results.items():
        if result is None:
            continue
        ours = results.get("ours in turn" if solver in INCREMENTAL else "ours")
        shown = [statistics.median(result[key]) if key in result else float("nan") for key in ("batch", "covariances")]
        ratios = "" if ours is None or solver.startswith("ours") else _ratios(ours, result)
        print(
            f"  {solver:18s} {shown[0]:10.4f} {result['chi2']:14.3f} {shown[1]:10.4f}"
            f" {result['memory']:8.0f}   {ratios}",
            flush=True,
        )


def _ratios(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    keys = [key for key in ("batch", "covariances") if key in ours and key in theirs]
    values = [statistics.median(ours[key]) / statistics.median(theirs[key]) for key in keys]
    values.append(ours["memory"] / max(theirs["memory"], 1.0))
    return "  ".join(f"{value:7.3f}" for value in values)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[34, 500, 2000])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--incremental", action="store_true", help="one submap after the other (minutes at 2000)")
    parser.add_argument("--node", action="store_true", help="one after the other as the node does (minutes at 500)")
    parser.add_argument("--only", nargs="+", help="these solvers alone")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--problem", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(child(arguments.child, arguments.problem, arguments.repeat)))
        sys.exit()
    needed = {"gtsam": "gtsam", "isam2": "gtsam", "ceres": "pycolmap"}
    wanted = [*BATCH, *(INCREMENTAL if arguments.incremental else ()), *(("ours node",) if arguments.node else ())]
    wanted = arguments.only or wanted
    present = [s for s in wanted if s not in needed or importlib.util.find_spec(needed[s]) is not None]
    print("left out, not installed:", ", ".join(s for s in wanted if s not in present) or "none")
    with tempfile.TemporaryDirectory() as temporary:
        for size in arguments.sizes:
            compare(size, present, arguments.repeat, Path(temporary))
