# SPDX-License-Identifier: Apache-2.0
"""Our multifrontal factor against CHOLMOD and SuperLU in place: the same joining problem, order and iterations.

    python benchmarks/joining/cholmod.py [--sizes 34 500 2000] [--repeat 3]

Only the sparse solver differs (parameter ``smoothing.estimator.solver``). Processor time of this process, medians, and
in brackets the ratio to ours. "analysis": symbolic work on a new pattern, as each new submap brings one. "factor": one
numeric factor and one solution. "batch": from chained odometry to the optimum, analysis included. "marginals": the
covariances of all poses and landmarks.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

from problems import flattened, joining_problem, local_maps, ring

from sjsam_node.joint_problem.joining import JoiningProblem
from slam_core.estimation.least_squares import LevenbergMarquardtConfig
from slam_core.linear_algebra.sparse_cholesky import SparseCholesky

BACKENDS = ("multifrontal", "cholmod", "superlu")
STOP = LevenbergMarquardtConfig(relative_tolerance=1e-6)
STEPS = ("analysis", "factor", "batch", "marginals")


def cpu_seconds(action: Callable[[], Any]) -> float:
    """Processor time of a call, s."""
    began = time.process_time()
    action()
    return time.process_time() - began


def compare(count: int, repeat: int) -> None:
    """Print a row per backend for a ring of ``count`` submaps."""
    maps, state = local_maps(ring(count), "joint", shared_only=True)
    flat = flattened(maps, "joint")
    times: dict[str, dict[str, list[float]]] = {name: {step: [] for step in STEPS} for name in BACKENDS}
    chi2 = {}
    for k in range(repeat + 1):  # in turn, so that other work on the machine hits all alike; the first turn warms up
        for name in BACKENDS:
            measured, chi2[name] = measure(flat, state, name)
            for step in STEPS if k else ():
                times[name][step].append(measured[step])
    for name in BACKENDS:
        ours = {step: statistics.median(times["multifrontal"][step]) for step in STEPS}
        own = {step: statistics.median(times[name][step]) for step in STEPS}
        cells = " | ".join(f"{1e3 * own[step]:.1f} ({own[step] / max(ours[step], 1e-9):.2f})" for step in STEPS)
        print(f"| {count} | {name} | {cells} | {chi2[name]:.3f} |", flush=True)


def measure(flat: Any, state: Any, backend: str) -> tuple[dict[str, float], float]:
    """Processor time of each step, s, and the chi2 reached."""
    problem = joining_problem(flat, state, backend)
    assert isinstance(problem, JoiningProblem)
    found = {"analysis": cpu_seconds(lambda: SparseCholesky(problem.factor.pattern, backend))}
    problem.linearize(state)
    found["factor"] = cpu_seconds(lambda: problem.solve(1e-9))
    reached = []
    found["batch"] = cpu_seconds(lambda: reached.append(joining_problem(flat, state, backend).optimize(state, STOP)[0]))
    found["marginals"] = cpu_seconds(lambda: problem.marginals(reached[0]))
    return found, problem.cost(reached[0])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[34, 500, 2000])
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    print(
        "| submaps | solver | analysis ms | factor ms | batch ms | marginals ms | chi2 |\n|---|---|---|---|---|---|---|"
    )
    for count in arguments.sizes:
        compare(count, arguments.repeat)


if __name__ == "__main__":
    main()
