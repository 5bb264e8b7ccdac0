# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of the stereo pair, off and auto: scale and accuracy of joined maps.

    python benchmarks/chain/self_calibration.py BAG ...

One line per bag, which needs ground truth: scale error of the joined trajectory (positive: too long), its ATE and
ANEES, and what the rectification was found to be wrong by.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.estimation.rigid_alignment import umeyama
from slam_viewer.results import AgentResult


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG")
    table = Table(title="stereo_self_calibration")
    for heading in (
        "bag",
        "off: scale %, ATE mm, ANEES",
        "auto: the same",
        "rows off px",
        "disparities off px",
        "corrected",
    ):
        table.add_column(heading)
    for bag in parser.parse_args().bags:
        off, auto = mapped(bag, "off"), mapped(bag, "auto")
        found = auto.front_end.rectification
        error = f"{found['disparity_error_px']:.2f} +- {found['disparity_error_sigma_px']:.2f}"
        rows = f"{found['row_error_px']:.2f}"
        table.add_row(bag.stem, figures(off), figures(auto), rows, error, str(found["corrected"]))
    Console(width=160).print(table)


def mapped(bag: Path, mode: str) -> AgentResult:
    config = choose(load_system_config(None, bag), "stereo", "sjsam", "none")
    front = config.feature_extractor
    front = replace(front, self_calibration=replace(front.self_calibration, mode=mode))
    return run_bag(bag, replace(config, feature_extractor=front))[0].agents[0]


def figures(agent: AgentResult) -> str:
    e = agent.evaluation()
    if e is None:
        return "no ground truth"
    return f"{scale_error_percent(agent):+.2f}, {1e3 * e.ate.rmse:.1f}, {e.anees or np.nan:.1f}"


def scale_error_percent(agent: AgentResult) -> float:
    """By how much the estimate is longer than the truth at the nearest stamps."""
    nearest = np.abs(agent.truth.stamps_ns[None, :] - agent.trajectory.stamps_ns[:, None]).argmin(axis=1)
    truth, estimate = agent.truth.poses[nearest, :3, 3], agent.trajectory.poses[:, :3, 3]
    T = umeyama(estimate, truth)
    turned = (estimate - estimate.mean(axis=0)) @ T[:3, :3].T
    scale = np.sum(turned * (truth - truth.mean(axis=0))) / np.sum(turned**2)
    return float(100.0 * (1.0 / scale - 1.0))


if __name__ == "__main__":
    main()
