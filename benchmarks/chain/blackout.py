# SPDX-License-Identifier: Apache-2.0
"""What an IMU and an odometry are worth: images that go black for a while, and roll and pitch over a run.

    python benchmarks/chain/blackout.py BAG [--start S ...] [--seconds 3] [--keep FOLDER]

BAG: a simulated bag with stereo pairs, IMU and ground truth, and perhaps wheels
(``slam simulate workshop_rig --profile ideal --wheels -o BAG``). The first rows are the bag as it is; the others have
black pairs from S seconds on. Errors are in the frame of the first pose: largest one in the dark and that of the first
frame after it, as the filter had them at the time, in mm and as a share of the way in the dark, and in the joined map;
ATE of the joined map; root mean square and largest error of roll and pitch of the filter and of the map. "Parts":
pieces of the map that nothing ties to each other, 1 if it is whole.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ekf_slam_node.config import ExternalOdometryConfig
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import associate
from slam_core.geometry import FloatArray, invert_transform
from slam_core.trajectory import Trajectory

_HEADINGS = (
    "black", "IMU", "odometry", "in the dark: filter, map mm", "after it: filter, map mm", "filter: % of the way",
    "map: ATE mm, ANEES", "parts", "frames bridged, lost", "roll and pitch, filter: rms, max deg", "map: rms, max deg",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Errors:
    """Of poses at times (n,) s since the first: position (n,) m, roll and pitch (n,) rad."""

    times: FloatArray
    position: FloatArray
    tilt: FloatArray

    @classmethod
    def of(cls, estimate: Trajectory, truth: Trajectory) -> Errors:
        """With the first pose at the truth."""
        matched, true_poses = associate(estimate, truth, 0.1, interpolate=True)
        poses = true_poses[0] @ invert_transform(matched.poses[0]) @ matched.poses
        # Where up is along the rig's axes: the last row of a rotation.
        tilt = np.linalg.norm(np.cross(poses[:, 2, :3], true_poses[:, 2, :3]), axis=1)
        position = np.linalg.norm(poses[:, :3, 3] - true_poses[:, :3, 3], axis=1)
        return cls((matched.stamps_ns - estimate.stamps_ns[0]) * 1e-9, position, np.arcsin(tilt))

    def tilts(self) -> str:
        """Root mean square and largest error of roll and pitch, degrees."""
        return f"{np.degrees(np.sqrt(np.mean(self.tilt**2))):.3f}, {np.degrees(self.tilt.max()):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--start", type=float, nargs="*", default=[5.0, 12.0, 18.0], help="seconds into the bag")
    parser.add_argument("--seconds", type=float, default=3.0, help="how long it is dark")
    parser.add_argument("--keep", type=Path, help="folder for the darkened bags")
    arguments = parser.parse_args()
    table = Table(title=f"{arguments.bag.name}, {arguments.seconds:.0f} s of black images")
    for heading in _HEADINGS:
        table.add_column(heading)
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for start in (None, *arguments.start):
            bag, dark = arguments.bag, (np.inf, np.inf)
            if start is not None:
                bag, dark = folder / f"dark_{start:g}.mcap", (start, start + arguments.seconds)
                darken(arguments.bag, bag, *dark)
            for imu, use in product(("off", "on"), ("off", "auto") if has_odometry(bag) else ("off",)):
                table.add_row(*row(bag, imu, use, *dark))
    Console(width=210).print(table)


def darken(source: Path, target: Path, start: float, end: float) -> None:
    """Copy a bag, with its stereo pictures black from ``start`` to ``end`` (s after the first of them)."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        types = {topic: info.type_name for topic, info in reader.topics.items()}
        stereo = [t for t, kind in types.items() if "stereo" in t and kind.endswith("Image")]
        first = next(message.stamp_ns for message in reader.raw(stereo))
        for topic, stamp_ns, data in reader.raw():
            if topic in stereo and start <= (stamp_ns - first) * 1e-9 < end:
                message = reader.decode(types[topic], data)
                writer.write(topic, replace(message, data=np.zeros_like(message.data)), stamp_ns)
            else:
                writer.write_raw(topic, types[topic], data, stamp_ns)


def has_odometry(bag: Path) -> bool:
    """True if a bag has an external odometry."""
    with BagReader(bag) as reader:
        return "/odometry" in reader.topics


def row(bag: Path, imu: str, use: str, start: float, end: float) -> list[str]:
    """One run of ``slam run``'s pipeline, without a dense model."""
    config = choose(load_system_config(None), "stereo", "sjsam", "none", imu)
    config = replace(config, dense_mapper=replace(config.dense_mapper, use_stereo=False, use_tof=False))
    config = replace(config, ekf_slam=replace(config.ekf_slam, odometry=ExternalOdometryConfig(use=use)))
    result, session = run_bag(bag, config)
    agent = result.agents[0]
    e = agent.evaluation()
    assert e is not None
    filtered, joined = (Errors.of(t, agent.truth) for t in (agent.filtered, agent.trajectory))
    counts = result.rejections
    return [
        "" if np.isinf(start) else f"{start:g} to {end:g} s", imu, use,
        *(", ".join(f"{1e3 * value(errors, start, end):.0f}" for errors in (filtered, joined)) if np.isfinite(start)
          else "" for value in (_in_the_dark, _after)),
        _shares(filtered, agent.truth, start, end),
        f"{1e3 * e.ate.rmse:.1f}, {e.anees or np.nan:.2f}", str(session.snapshot.components),
        f"{counts.get('frames_bridged', 0)}, {counts.get('frames_lost', 0)}", filtered.tilts(), joined.tilts(),
    ]  # fmt: skip


def _in_the_dark(errors: Errors, start: float, end: float) -> float:
    inside = (errors.times >= start) & (errors.times < end)
    return float(errors.position[inside].max()) if inside.any() else np.nan


def _shares(errors: Errors, truth: Trajectory, start: float, end: float) -> str:
    """Largest error in the dark and the first after it, % of the way in the dark."""
    if np.isinf(start):
        return ""
    times = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    dark = truth.poses[(times >= start) & (times <= end), :3, 3]
    way = float(np.linalg.norm(np.diff(dark, axis=0), axis=1).sum())
    return ", ".join(f"{100.0 * value(errors, start, end) / way:.2f}" for value in (_in_the_dark, _after))


def _after(errors: Errors, start: float, end: float) -> float:
    return float(errors.position[np.flatnonzero(errors.times >= end)[0]])


if __name__ == "__main__":
    main()
