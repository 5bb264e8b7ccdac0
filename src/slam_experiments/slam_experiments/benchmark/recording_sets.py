# SPDX-License-Identifier: Apache-2.0
"""Recordings of a data folder: the public ones by name, and any bag with ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
    """

    name: str
    kind: str
    source: Path
    mode: str
    runs: tuple[str, ...]
    truth: str
    calibration: Path | None = None
    ground_truth: Path | None = None

    def write_bag(self, target: Path) -> None:
        """Convert the source to a bag."""
        dataset = DATASETS[self.kind](self.source, self.calibration, self.ground_truth, None)
        with BagWriter(target) as bag:
            for _ in dataset.write(SensorWriter(bag)):
                pass


def public_sets(folder: Path) -> dict[str, RecordingSet]:
    """The public recordings that are known, by name, whether they are in the folder or not."""
    v101 = {
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


def sets_of(folder: Path) -> dict[str, RecordingSet]:
    """The public recordings and the bags that lie in a folder, by name.

    Raises
    ------
    ValueError
        If it holds neither, or a bag of several agents or without ground truth.
    """
    found = {name: s for name, s in public_sets(folder).items() if s.source.exists()}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".mcap", ".db3", ".bag") or (path / "metadata.yaml").exists():
            found[path.stem] = _bag(path)
    if not found:
        raise ValueError(f"{folder} holds neither a bag nor a public recording ({', '.join(public_sets(folder))})")
    return found


def _bag(path: Path) -> RecordingSet:
    with SensorBag(path) as bag:
        if len(bag.agents) > 1:
            raise ValueError(f"{path} holds {len(bag.agents)} agents: only bags of one are compared")
        sensors = bag.sensors[bag.agents[0]]
    if "ground_truth" not in sensors.topics:
        raise ValueError(f"{path} has no ground truth (ground_truth/pose)")
    mode = "tof" if sensors.left is None else "stereo"
    return RecordingSet(path.stem, "", path, mode, _DEPTH_RUNS if mode == "tof" else ("alone",), "")
