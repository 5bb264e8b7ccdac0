"""Joins every set of Linear SLAM text submaps in a folder, and simulated ones of the sizes that are not at hand.

    python benchmarks/joining/linear_slam.py [FOLDER] [--seeds 1]

For each: time, chi2, of the simulated ones the degrees of freedom that it should be near, where the chained start lay,
and which way led to the optimum. Public sets with both libraries too.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import problems
from text_world import SETS, ring

from sjsam_node.linear_slam_text import TextMap, find_maps, read_maps
from sjsam_node.text_joining import TextJoiningConfig, join_text_maps


def row(name: str, maps: list[TextMap], dimension: int, solver: str = "auto", *, simulated: bool = False) -> None:
    began = time.perf_counter()
    result = join_text_maps(maps, dimension, TextJoiningConfig(solver=solver))
    seconds = time.perf_counter() - began
    rows = sum(m.poses.size + m.features.size for m in maps)
    free = rows - (result.poses.size - result.poses.shape[1]) - result.features.size
    expected = f"dof {free:6d}" if simulated else " " * 10
    print(f"{name:36s} {dimension}D {len(maps):5d} {result.solver:12s} {seconds:7.2f} s  chi2 {result.chi2:14.6f}"
          f"  {expected}  start {result.start_chi2:10.4g}  best {result.start}", flush=True)  # fmt: skip


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
            maps = simulate(seed)
            row(name, maps, 2 if maps[0].poses.shape[1] == 3 else 3, simulated=True)
