# SPDX-License-Identifier: Apache-2.0
"""Range-bearing logs with known and with unknown association: RMSE of the path, m.

    python benchmarks/ekf/plane.py LOG...

``steps``: each step associated on its own, by JCBB; ``hypotheses``: several followed over the whole drive. A log
without truth (Victoria Park) is compared with its path smoothed with known association.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam_experiments.planar.ekf import PlanarConfig
from slam_experiments.planar.log import PlanarLog
from slam_experiments.planar.mapping import accuracy, map_log
from slam_experiments.planar.naming import named
from slam_experiments.planar.readers import read_log

COLUMNS = ("known", "steps", "hypotheses")


def with_reference(log: PlanarLog) -> PlanarLog:
    """The log with its smoothed path as truth where it has none."""
    (robot,) = log.robots
    if robot.truth is not None:
        return log
    return replace(log, robots=(replace(robot, truth=map_log(log, "sam").paths[0].poses),))


def row(log: PlanarLog) -> str:
    log = with_reference(log)
    robot = log.robots[0]
    config = PlanarConfig(sigma_range=log.sigma_range, sigma_bearing=log.sigma_bearing)
    start = np.zeros(3) if robot.truth is None else robot.truth[0]
    own_names = replace(log, robots=(named(robot, start, config),))
    cells = []
    for method in ("ekf", "sam"):
        for asked, association in ((log, "known"), (log, "jcbb"), (own_names, "known")):
            result = map_log(asked, method, association)
            cells.append(f"{accuracy(robot, result.paths[0])['rmse_m']:12.3f}")
    landmarks = len(np.unique(np.concatenate(robot.ids))), len(result.landmarks)
    return f"{log.name + ' ' + robot.name:24}" + "".join(cells) + "{:12d}{:12d}".format(*landmarks)


def main() -> None:
    heading = "".join(f"{name:>12}" for name in COLUMNS)
    print(f"{'':24}{'EKF':>12}{'SAM':>36}{'landmarks':>36}\n{'':24}{heading}{heading}{'true':>12}{'found':>12}")
    logs = [read_log(Path(path)) for path in sys.argv[1:]]
    alone = [replace(log, robots=(robot,)) for log in logs for robot in log.robots]
    with ProcessPoolExecutor(len(alone)) as pool:
        for line in pool.map(row, alone):
            print(line, flush=True)


if __name__ == "__main__":
    main()
