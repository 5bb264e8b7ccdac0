# SPDX-License-Identifier: Apache-2.0
"""How the time per submap grows with the map: exploring without closures, and lap after lap with them.

    python benchmarks/joining/growth.py [--submaps 500] [--laps 4]

Prints median and mean CPU time of GlobalMap.add over stretches of the map, the unknowns of the last update, and memory.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from problems import ring

from sjsam_node.global_map import GlobalMap


def grow(count: int, laps: float, label: str) -> None:
    problem = ring(count, laps, density=12.0)
    global_map, times, unknowns = GlobalMap(), [], []
    for submap in problem.submaps:
        began = time.process_time()
        global_map.add(submap)
        times.append(time.process_time() - began)
        unknowns.append(global_map.state.problem(0).problem.layout.pattern.n)
    began = time.process_time()
    global_map.settle()
    global_map.trajectory()
    settled = time.process_time() - began
    milliseconds, step = 1e3 * np.array(times), max(count // 8, 10)
    print(f"{label}: {count} submaps, {len(problem.submaps[0].landmarks)} landmarks in the first, {laps} laps")
    for first in range(0, count, step):
        part = milliseconds[first : first + step]
        print(
            f"  {first:5d}-{first + len(part):5d}  median {np.median(part):8.1f} ms  mean {part.mean():8.1f} ms"
            f"  unknowns {unknowns[first + len(part) - 1]:6d}"
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"  total {sum(times):.1f} s, final batch with all covariances {settled:.2f} s, peak {peak:.0f} MiB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--submaps", type=int, default=500)
    parser.add_argument("--laps", type=float, default=4.0)
    arguments = parser.parse_args()
    grow(arguments.submaps, 0.9, "without closures")
    grow(arguments.submaps, arguments.laps, "with closures")
