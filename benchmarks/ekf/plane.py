# SPDX-License-Identifier: Apache-2.0
"""Range-bearing logs with known and with unknown association: RMSE of the path, m.

    python benchmarks/ekf/plane.py LOG...

``steps``: each step associated on its own, by JCBB; ``hypotheses``: several followed over the whole drive. A log
without truth (Victoria Park) is compared with its path smoothed with known association.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from slam_bringup.planar.log import PlanarLog
from slam_bringup.planar.mapping import accuracy, map_log
from slam_bringup.planar.readers import read_log

ASSOCIATIONS = {"known": "known", "steps": "jcbb", "hypotheses": "hypotheses"}


def with_reference(log: PlanarLog) -> PlanarLog:
    """The log with its smoothed path as truth where it has none."""
    (robot,) = log.robots
    if robot.truth is not None:
        return log
    return replace(log, robots=(replace(robot, truth=map_log(log, "sam").paths[0].poses),))


def row(log: PlanarLog) -> str:
    log = with_reference(log)
    cells = []
    for method in ("ekf", "sam"):
        for association in ASSOCIATIONS.values():
            result = map_log(log, method, association)
            cells.append(f"{accuracy(log.robots[0], result.paths[0])['rmse_m']:12.3f}")
        cells.append(f"{len(result.landmarks):6d}")
    return f"{log.name + ' ' + log.robots[0].name:24}" + "".join(cells)


def main() -> None:
    heading = "".join(f"{name:>12}" for name in ASSOCIATIONS) + "   map"
    print(f"{'':24}{'EKF':^42}{'SAM':^42}\n{'':24}{heading}{heading}")
    for path in sys.argv[1:]:
        log = read_log(Path(path))
        for robot in log.robots:
            print(row(replace(log, robots=(robot,))), flush=True)


if __name__ == "__main__":
    main()
