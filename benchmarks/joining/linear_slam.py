"""Joins every set of Linear SLAM text submaps in a folder, and simulated ones of sizes that are not at hand.

    python benchmarks/joining/linear_slam.py [FOLDER]

For each: chi2 at the optimum from the chained start alone and as joined, time, both solvers.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import problems
from text_world import simulate

from sjsam_node.linear_slam_text import TextMap, find_maps, read_maps
from sjsam_node.text_joining import TextJoiningConfig, join_text_maps

SIMULATED = ((200, 3), (870, 3), (700, 2), (3000, 2))


def row(name: str, maps: list[TextMap], dimension: int) -> None:
    for solver in ("cholmod", "superlu"):
        began = time.perf_counter()
        result = join_text_maps(maps, dimension, TextJoiningConfig(solver=solver))
        seconds = time.perf_counter() - began
        print(f"{name:32s} {dimension}D {len(maps):5d} {solver:8s} {seconds:8.2f} s  chi2 {result.chi2:16.6f}"
              f"  start {result.start_chi2:12.4g}  best from {result.start}")  # fmt: skip


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else problems.ROOT.parent / "shared/data/linear_slam_txt"
    row("(compiles)", simulate(20, 2), 2)
    row("(compiles)", simulate(20, 3), 3)
    for sub in sorted(p for p in folder.glob("*") if p.is_dir() and any(p.glob("localmap_*.txt"))):
        row(sub.name, *read_maps(find_maps(sub)))
    for count, dimension in SIMULATED:
        row("simulated ring", simulate(count, dimension), dimension)
