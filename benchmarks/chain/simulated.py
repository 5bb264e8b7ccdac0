# SPDX-License-Identifier: Apache-2.0
"""The thesis's experiments on simulated bags (chapter 9): render, map offline, compare with the truth.

    python benchmarks/chain/simulated.py [SCENARIO[/EVERY][:MODE] ...] [--keep FOLDER] [--profile ideal|real]
        [--config FILE]

EVERY keeps each n-th frame, MODE is stereo, tof, replace or fuse; the scale error is positive for a map that is too
large. Bags are kept in FOLDER and used again. The second
table has one row per agent of the runs with several: what it sends (bytes of its submap messages per metre of way), how
far the map is from a central one, to which all submaps are given agent after agent, and how far it was while they came
in, in the order in which they were finished.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from self_calibration import scale_error_percent

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.smoothing.solver import EstimatorConfig, SmootherConfig
from slam_bags.storage.bag_types import BagTypes, typestore
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import Evaluation
from slam_core.messages import submap_messages
from slam_core.trajectory import Trajectory
from slam_core.types import Submap
from slam_simulation.sensors.profiles import PROFILES
from slam_viewer.results import RunResult, summarise

DEFAULT = (
    "workshop_rig", "workshop_handheld", "fireman_10hz", "fireman_5hz", "sweep", "conference", "two_rooms/2",
    "figure_eight/4", "five_rooms/4", "small_room/3:stereo", "small_room/3:tof", "small_room/3:replace",
    "small_room/3:fuse", "firemen_2", "firemen_3/2",
)  # fmt: skip
HEADINGS = (
    "run", "frames", "path m", "submaps", "closures", "lost", "landmarks", "scale %", "ATE mm", "end mm", "end deg",
    "ANEES", "ANEES block", "filter: ATE mm", "end mm", "ANEES", "ms features", "ms ekf", "merge ms/submap", "max",
    "x real time",
)  # fmt: skip
AGENT_HEADINGS = ("run", "agent", "path m", "submaps", "sent kB/m", "compact", "ATE mm", "end mm", "ANEES",
                  "from central mm", "as they came: ATE mm", "from central mm")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=DEFAULT, metavar="RUN")
    parser.add_argument("--keep", type=Path, help="folder for the bags")
    parser.add_argument("--profile", choices=PROFILES, default="ideal", help="how hard the rendering is")
    parser.add_argument("--config", type=Path, help="parameters of all nodes, as slam run takes them")
    arguments = parser.parse_args()
    table, agents = Table(title="simulated experiments, against the truth"), Table(title="several agents in one map")
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    for heading in AGENT_HEADINGS:
        agents.add_column(heading, justify="right")
    with tempfile.TemporaryDirectory() as scratch:
        for run in track(arguments.runs, description="mapping", console=Console(stderr=True)):
            name, _, mode = run.partition(":")
            bag = bag_of(name, arguments.keep or Path(scratch), arguments.profile)
            result, session = run_bag(
                bag, choose(load_system_config(arguments.config, bag), mode or "stereo", "sjsam", "none")
            )
            submaps = list(session.snapshot.submaps)
            table.add_row(run, *row(result, submaps))
            if len(result.agents) > 1:
                for cells in agent_rows(result, submaps):
                    agents.add_row(run, *cells)
    Console(width=220).print(table)
    if agents.rows:
        Console(width=220).print(agents)


def row(result: RunResult, submaps: list[Submap]) -> list[str]:
    summary, agent = summarise(result), result.agents[0]
    joined, filtered = agent.evaluation(), agent.evaluation(agent.filtered)
    assert joined is not None
    assert filtered is not None
    block = GlobalMapConfig(smoothing=SmootherConfig(estimator=EstimatorConfig(rows="block")))
    by_blocks = agent.evaluation(joined_again(submaps, block)[agent.name])
    assert by_blocks is not None
    counts = [summary[key] for key in ("submaps", "loop_closures")]
    lost = sum("LOST" in event for event in result.events)
    ms = result.stage_ms
    front_end = np.add(ms["keypoints"], ms["features"])
    times = [np.median(front_end), np.median(ms["ekf"]), np.median(ms["sjsam"]), np.max(ms["sjsam"])]
    return [
        str(summary["frames"]), f"{joined.truth_length_m:.1f}", *map(str, counts), str(lost), str(summary["landmarks"]),
        f"{scale_error_percent(agent):+.2f}", *accuracy(joined), f"{by_blocks.anees:.2f}",
        f"{1e3 * filtered.ate.rmse:.1f}", f"{1e3 * filtered.end_error_m:.1f}", f"{filtered.anees:.2f}",
        *(f"{t:.0f}" for t in times), f"{summary['real_time_factor']:.1f}",
    ]  # fmt: skip


def joined_again(
    submaps: list[Submap], config: GlobalMapConfig | None = None, *, as_they_came: bool = False
) -> dict[str, Trajectory]:
    """Every agent's trajectory in a map to which the submaps are given agent after agent, or as they came."""
    joined = GlobalMap(config)
    for submap in sorted(submaps, key=lambda s: s.end_stamp_ns if as_they_came else (s.agent, s.index)):
        joined.add(submap)
    joined.settle()
    return {agent: Trajectory.from_estimates(poses) for agent, poses in joined.trajectory().items()}


def agent_rows(result: RunResult, submaps: list[Submap]) -> Iterator[list[str]]:
    central, online = joined_again(submaps), joined_again(submaps, as_they_came=True)
    for agent in result.agents:
        own = [s for s in submaps if s.agent == agent.name]
        joined, early = agent.evaluation(), agent.evaluation(online[agent.name])
        assert joined is not None
        assert early is not None
        at = central[agent.name].poses[:, :3, 3]
        gaps = [np.linalg.norm(t.poses[:, :3, 3] - at, axis=1).max() for t in (agent.trajectory, online[agent.name])]
        sent = [sum(size_of(s, compact) for s in own) / joined.truth_length_m for compact in (False, True)]
        yield [
            agent.name, f"{joined.truth_length_m:.1f}", str(len(own)), *(f"{1e-3 * s:.0f}" for s in sent),
            f"{1e3 * joined.ate.rmse:.1f}", f"{1e3 * joined.end_error_m:.1f}", f"{joined.anees:.2f}",
            f"{1e3 * gaps[0]:.1f}", f"{1e3 * early.ate.rmse:.1f}", f"{1e3 * gaps[1]:.1f}",
        ]  # fmt: skip


def size_of(submap: Submap, compact: bool) -> int:
    """Bytes of a submap's messages on the wire (CDR)."""
    messages = submap_messages(BagTypes(), submap, compact=compact)
    return sum(len(typestore().serialize_cdr(message, message.__msgtype__)) for message in messages)


def accuracy(e: Evaluation) -> list[str]:
    return [
        f"{1e3 * e.ate.rmse:.1f}",
        f"{1e3 * e.end_error_m:.1f}",
        f"{e.end_error_deg:.3f}",
        f"{e.anees:.2f}",
    ]


def bag_of(name: str, folder: Path, profile: str = "ideal") -> Path:
    scenario, _, every = name.partition("/")
    bag = folder / f"{name.replace('/', '_every_')}{'_real' * (profile == 'real')}.mcap"
    if not bag.exists():
        command = ["simulate", scenario, "--profile", profile, "-o", str(bag), "--images", "jpeg", "--compact"]
        command += ["--every", every or "1"]
        slam(command, standalone_mode=False)
    return bag


if __name__ == "__main__":
    main()
