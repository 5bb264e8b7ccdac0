# SPDX-License-Identifier: Apache-2.0
"""Recordings in variants: later starts, fewer frames, backwards, other gates. A change is judged by all of them.

    python benchmarks/chain/robustness.py [NAME | BAG ...] [--config FILE] [--runs RUN ...] [--keep FOLDER]
        [--variants VARIANT ...] [--json FILE]

NAME: as in ``recordings.py``; a BAG is mapped in mode stereo and has an exact truth. The sensors' part runs once (and
is kept in the folder, if one is named, until it is deleted there); each variant gives what it found to a filter and a
map of its own. Backwards, stamps are mirrored, motions inverted and turn rates negated: what a rig would measure that
goes the way back.

Per run and over the variants: median and worst of ATE (mm), ANEES with the truth's errors and claimed position sigma
over ATE, of the joined map and of the filter alone; chain: how many maps have submaps that contradict each other.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from recordings import RECORDINGS, Row, row_of
from rich.console import Console
from rich.table import Table

from ndt_registration.stage import ScanEstimate
from sjsam_node.map_session import MapSession
from slam_bags.reading.readings import AgentSensors
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import SystemConfig, choose, load_system_config
from slam_bringup.pipeline.mapper import Mapper
from slam_bringup.pipeline.sensor_pipeline import AgentItem, SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.geometry import inverse_jacobian, invert_transform
from slam_core.trajectory import Trajectory
from slam_core.types import Features, ImuSample

_NAMES = ("redkitchen", "hololens", "mh01", "v101", "kitti1")
VARIANTS = ("as it is", "from 3", "from 7", "from 12", "every second", "backwards", "gate 0.9985", "gate 0.9993")


@dataclass(frozen=True, eq=False)
class Take:
    """What the sensors' part found in a bag, in the order in which the filter gets it."""

    items: list[AgentItem]
    sensors: AgentSensors
    truth: Trajectory


@dataclass(frozen=True, eq=False)
class Outcome:
    """Rows of the joined map and of the filter alone of one variant; whether submaps contradict each other."""

    joined: Row
    filtered: Row
    fell_back: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=_NAMES, metavar="NAME")
    parser.add_argument("--config", type=Path, help="parameters, as of slam run")
    parser.add_argument("--runs", nargs="*", help="only these of alone, ndt and imu")
    parser.add_argument("--variants", nargs="*", default=VARIANTS, choices=VARIANTS, metavar="VARIANT")
    parser.add_argument("--keep", type=Path, help="folder of bags and of what the sensors' part found in them")
    parser.add_argument("--json", type=Path, help="write every row there")
    arguments = parser.parse_args()
    table, rows = _table(), []
    for name in arguments.names:
        for run in RECORDINGS[name].runs if name in RECORDINGS else ("alone",):
            if arguments.runs and run not in arguments.runs:
                continue
            outcomes = list(outcomes_of(name, run, arguments.variants, arguments.keep, arguments.config))
            table.add_row(*_cells(name, run, outcomes))
            rows += [asdict(row) for o in outcomes for row in (o.joined, o.filtered)]
    Console(width=150).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


def outcomes_of(
    name: str, run: str, variants: Sequence[str], keep: Path | None, config: Path | None = None
) -> Iterator[Outcome]:
    """The outcome of each variant, also told on stderr."""
    recording = RECORDINGS.get(name)
    mode, truth = ("stereo", "") if recording is None else (recording.mode, recording.truth)
    odometry = "ndt" if run == "ndt" else "none"
    system = choose(load_system_config(config), mode, "sjsam", odometry, "on" if run == "imu" else "off")
    take = _take(_bag(name, keep), system, odometry, None if keep is None else keep / f"{Path(name).name}_{run}.take")
    for variant in variants:
        outcome = map_of(take, system, variant, Path(name).name, run, truth)
        print(f"{name}, {run}, {variant}: " + ", ".join(_told([outcome])), file=sys.stderr, flush=True)
        yield outcome


def _bag(name: str, keep: Path | None) -> Path:
    if name not in RECORDINGS:
        return Path(name)
    if keep is None:
        raise SystemExit(f"'{name}' is converted to a bag first: name a folder for it with --keep")
    bag = keep / f"{name}.mcap"
    if not bag.exists():
        keep.mkdir(parents=True, exist_ok=True)
        slam(["convert", *map(str, RECORDINGS[name].source), "-o", str(bag)], standalone_mode=False)
    return bag


def _take(path: Path, system: SystemConfig, odometry: str, kept: Path | None) -> Take:
    if kept is not None and kept.exists():
        return Take(*pickle.loads(kept.read_bytes()))
    with SensorBag(path) as bag:
        agent = bag.agents[0]
        sensors, truth = bag.sensors[agent], bag.ground_truth(agent)
        pipeline = SensorPipeline(system, sensors, odometry != "none", StageTimes())
        items = [_slim(pipeline.measure(i)) for reading in bag.readings() for i in pipeline.add(reading)]
        items += [_slim(pipeline.measure(i)) for i in pipeline.finish()]
    if truth is None:
        raise SystemExit(f"{path} has no ground truth")
    take = Take(items, sensors, truth)
    if kept is not None:
        kept.write_bytes(pickle.dumps((items, sensors, truth)))
    return take


def _slim(item: AgentItem) -> AgentItem:
    """An item without the points of a scan."""
    if not isinstance(item.value, ScanEstimate):
        return item
    scan = replace(item.value.scan, points=np.zeros((0, 3)))
    return replace(item, value=replace(item.value, scan=scan, result=None))


def map_of(take: Take, system: SystemConfig, variant: str, name: str, run: str, known: str) -> Outcome:
    """Map the items of a take as the variant has them."""
    if variant.startswith("gate"):
        association = replace(system.ekf_slam.association, probability=float(variant.split()[1]))
        system = replace(system, ekf_slam=replace(system.ekf_slam, association=association))
    backwards = variant == "backwards"
    session = MapSession(system.sjsam)
    mapping = Mapper(system, {"": take.sensors}, StageTimes(), session)
    for item in _backwards(take.items) if backwards else _fewer(take.items, variant):
        mapping.process(replace(item, agent=""))
    mapping.finish()
    record = mapping.record(0.0, {}, "")
    truth = _mirrored(take.truth, take.items) if backwards else take.truth
    lost = record.rejections.get("frames_lost", 0)
    joined = Trajectory.from_estimates(record.trajectories[""])
    filtered = Trajectory.from_estimates(record.agents[""].filtered)
    return Outcome(
        row_of(name, f"{run}, {variant}", joined, truth, known, lost, None),
        row_of(name, f"{run}, {variant}, filter", filtered, truth, known, lost, None),
        session.snapshot.overconfidence != "",
    )


# ---- variants
def _fewer(items: list[AgentItem], variant: str) -> Iterator[AgentItem]:
    """The items without some of the frames."""
    first = int(variant.split()[1]) if variant.startswith("from") else 0
    frame = -1
    for item in items:
        if isinstance(item.value, Features):
            frame += 1
            if frame < first or (variant == "every second" and frame % 2):
                continue
        elif frame < first - 1:
            continue
        yield item


def _backwards(items: list[AgentItem]) -> list[AgentItem]:
    """What a rig would measure that goes the way back: stamps mirrored, motions inverted, turn rates negated."""
    turn = _mirror(items)
    found = []
    for item in items:
        value: Any = item.value
        if isinstance(value, Features):
            value = replace(value, stamp_ns=turn - value.stamp_ns)
        elif isinstance(value, ImuSample):
            value = replace(value, stamp_ns=turn - value.stamp_ns, angular_velocity=-value.angular_velocity)
        elif value.motion is None:
            continue
        else:
            m = value.motion
            J = inverse_jacobian(m.T)
            motion = type(m)(
                turn - m.end_stamp_ns, turn - m.start_stamp_ns, invert_transform(m.T), J @ m.covariance @ J.T
            )
            value = replace(value, motion=motion, pose=replace(value.pose, stamp_ns=motion.end_stamp_ns))
        found.append(replace(item, value=value))
    # At equal stamps readings and motions come before the frame that they end at.
    return sorted(found, key=lambda i: (_stamp(i), isinstance(i.value, Features)))


def _mirrored(truth: Trajectory, items: list[AgentItem]) -> Trajectory:
    return Trajectory(_mirror(items) - truth.stamps_ns[::-1], truth.poses[::-1])


def _mirror(items: list[AgentItem]) -> int:
    """Sum of a stamp and its mirror image, ns."""
    stamps = [_stamp(item) for item in items]
    return min(stamps) + max(stamps)


def _stamp(item: AgentItem) -> int:
    value: Any = item.value
    return int(value.pose.stamp_ns if isinstance(value, ScanEstimate) else value.stamp_ns)


# ---- output
_HEADINGS = ("ATE mm", "ANEES", "sigma / ATE", "filter: ATE", "ANEES", "sigma / ATE", "chain")


def _told(outcomes: list[Outcome]) -> list[str]:
    """Median and worst of each figure; the worst sigma is the smallest."""
    cells = []
    for rows in ([o.joined for o in outcomes], [o.filtered for o in outcomes]):
        for values, worst, digits in (
            ([r.ate_mm for r in rows], max, 1),
            ([r.anees_with_truth_errors or 0.0 for r in rows], max, 2),
            ([r.sigma_over_ate or 0.0 for r in rows], min, 2),
        ):
            text = f"{np.median(values):.{digits}f}"
            cells.append(text if len(values) == 1 else f"{text}, {worst(values):.{digits}f}")
    return [*cells, str(sum(o.fell_back for o in outcomes))]


def _table() -> Table:
    table = Table(title="recordings in variants: median, worst")
    for heading in ("recording", "run", *_HEADINGS):
        table.add_column(heading, justify="left" if heading in ("recording", "run") else "right")
    return table


def _cells(name: str, run: str, outcomes: list[Outcome]) -> list[str]:
    return [Path(name).name, run, *_told(outcomes)]


if __name__ == "__main__":
    main()
