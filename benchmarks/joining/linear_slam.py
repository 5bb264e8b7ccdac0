# SPDX-License-Identifier: Apache-2.0
"""Joins every set of Linear SLAM text submaps in a folder, and simulated ones of the sizes that are not at hand.

    python benchmarks/joining/linear_slam.py [FOLDER] [--seeds 1]

For each: time, chi2, where the chained start lay, and which way led to the optimum; of the simulated ones the degrees
of freedom that chi2 should be near, and the chi2 that is reached from the truth. Public sets with all libraries.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import problems
from text_world import SETS, ring

from slam_experiments.linear_slam.text_joining import (
    TextIndex,
    TextJoiner,
    TextJoiningConfig,
    TextJoiningResult,
    join_text_maps,
)
from slam_experiments.linear_slam.text_maps import TextMap, find_maps, read_maps


def row(
    name: str, maps: list[TextMap], dimension: int, solver: str = "auto", exact: list[TextMap] | None = None
) -> None:
    """Join a set and print its line; ``exact`` is the same set without noise, where it is known."""
    began = time.perf_counter()
    result = join_text_maps(maps, dimension, TextJoiningConfig(solver=solver))
    seconds = time.perf_counter() - began
    expected = "" if exact is None else _expected(maps, exact, dimension, result)
    print(
        f"{name:36s} {dimension}D {len(maps):5d} {result.solver:12s} {seconds:7.2f} s  chi2 {result.chi2:14.6f}"
        f"  {expected}  start {result.start_chi2:10.4g}  best {result.start}",
        flush=True,
    )


def _expected(maps: list[TextMap], exact: list[TextMap], dimension: int, result: TextJoiningResult) -> str:
    rows = sum(m.poses.size + m.features.size for m in maps)
    free = rows - (result.poses.size - result.poses.shape[1]) - result.features.size
    truth = TextJoiner(TextIndex.of(exact, dimension), TextJoiningConfig()).chained()
    best = TextJoiner(TextIndex.of(maps, dimension), TextJoiningConfig()).optimize(truth)[1].cost
    return f"dof {free:6d}  from the truth {best:14.6f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=problems.ROOT.parent / "shared/data/linear_slam_txt")
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    for d in (2, 3):
        row("(compiles)", ring(20, d), d)
    for sub in sorted(p for p in arguments.folder.glob("*") if p.is_dir() and any(p.glob("localmap_*.txt"))):
        for library in ("multifrontal", "cholmod", "superlu"):
            row(sub.name, *read_maps(find_maps(sub)), library)
    for name, simulate in SETS.items():
        for seed in range(arguments.seeds):
            maps, exact = simulate(seed, 1.0), simulate(seed, 1e-7)
            row(name, maps, 2 if maps[0].poses.shape[1] == 3 else 3, exact=exact)
