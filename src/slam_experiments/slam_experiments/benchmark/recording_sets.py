# SPDX-License-Identifier: Apache-2.0
"""Recordings of a data folder: the public ones by name, and any bag with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import SensorWriter
from slam_bringup.commands.convert import DATASETS

_DEPTH_RUNS = ("alone", "ndt")


@dataclass(frozen=True)
class RecordingSet:
    """A recording and how it is mapped.

    Attributes
    ----------
    name
        Name in the tables.
    kind
        How it is converted to a bag ("euroc", "kitti", "rgbd"); "" for a bag.
    source
        The recording.
    mode
        "stereo" or "tof".
    runs
        "alone", "imu" (with the IMU) and "ndt" (with scan odometry).
    truth
        Name in ``slam_experiments.benchmark.truth.TRUTH``; "": exact.
    calibration, ground_truth
        Where the source itself has none.
    failed
        Why it cannot be mapped or compared, else "".
    """

    name: str
    kind: str
    source: Path
    mode: str
    runs: tuple[str, ...]
    truth: str
    calibration: Path | None = None
    ground_truth: Path | None = None
    failed: str = ""

    def write_bag(self, target: Path) -> None:
        """Convert the source to a bag."""
        dataset = DATASETS[self.kind](self.source, self.calibration, self.ground_truth, None)
        with BagWriter(target) as bag:
            for _ in dataset.write(SensorWriter(bag)):
                pass


def public_sets(folder: Path) -> dict[str, RecordingSet]:
    """The public recordings that are known, by name, whether they are in the folder or not."""
    v101: dict[str, Any] = {
        "calibration": folder / "euroc_v101_micro95/MicroEurocDataset",
        "ground_truth": folder / "traj_gt_openvins/euroc_mav/V1_01_easy.txt",
    }
    early = folder / "euroc_v101_visnav100/euroc_V1"
    kitti = folder / "kitti_stereo_51x2"
    sets = (
        RecordingSet("mh01", "euroc", folder / "euroc_mh01_10hz", "stereo", ("imu", "alone"), "euroc"),
        RecordingSet("v101", "euroc", early, "stereo", ("alone",), "euroc", **v101),
        RecordingSet("kitti1", "kitti", kitti / "KITTI_sequence_1", "stereo", ("alone",), "kitti"),
        RecordingSet("kitti2", "kitti", kitti / "KITTI_sequence_2", "stereo", ("alone",), "kitti"),
        RecordingSet("hololens", "rgbd", folder / "hololens_office_120", "tof", _DEPTH_RUNS, "hololens"),
        RecordingSet("redkitchen", "rgbd", folder / "rgbd_tsdf_1000", "tof", _DEPTH_RUNS, "redkitchen"),
    )
    return {s.name: s for s in sets}


def sets_of(folder: Path, names: Sequence[str] = ()) -> dict[str, RecordingSet]:
    """The public recordings and the bags that lie in a folder, by name; only those of ``names`` if there are any.

    Raises
    ------
    ValueError
        If it holds neither, or nothing of a name.
    """
    public = public_sets(folder)
    found: dict[str, Path | None] = {name: None for name, s in public.items() if s.source.exists()}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".mcap", ".db3", ".bag") or (path / "metadata.yaml").exists():
            found[path.stem] = path
    if not found:
        raise ValueError(f"{folder} holds neither a bag nor a public recording ({', '.join(public)})")
    if unknown := [name for name in names if name not in found]:
        raise ValueError(f"no recording '{unknown[0]}' in the data folder; there are {', '.join(found)}")
    chosen = [(name, found[name]) for name in names or found]
    return {name: public[name] if bag is None else _bag(bag) for name, bag in chosen}


def _bag(path: Path) -> RecordingSet:
    """A bag, or one that has failed: of several agents, without ground truth, or one that does not open."""
    try:
        with SensorBag(path) as bag:
            agents, sensors = bag.agents, bag.sensors[bag.agents[0]]
    except ValueError as error:
        return RecordingSet(path.stem, "", path, "stereo", ("alone",), "", failed=str(error))
    failed = ""
    if len(agents) > 1:
        failed = f"{path} holds {len(agents)} agents: only bags of one are compared"
    elif "ground_truth" not in sensors.topics:
        failed = f"{path} has no ground truth (ground_truth/pose)"
    mode = "tof" if sensors.left is None else "stereo"
    return RecordingSet(path.stem, "", path, mode, _DEPTH_RUNS if mode == "tof" else ("alone",), "", failed=failed)
