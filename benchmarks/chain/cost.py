# SPDX-License-Identifier: Apache-2.0
"""What a frame costs: CPU time of every stage and of the whole of ``slam run``, real-time factors, peak memory.

    python benchmarks/chain/cost.py [CASE ...] [--against CHECKOUT] [--runs N] [--frames N] [--keep FOLDER]

CASE: rig (stereo), rig_full (fuse + scan odometry + IMU), mh01, redkitchen, hololens, redkitchen_ndt and hololens_ndt
(with scan odometry), redkitchen_800 (800 frames, forwards and backwards; for the memory). Runs of this checkout and of
another one take turns; the table has medians and their ratio. CPU time is user and system time of the process: it
hardly changes where others use the machine, while wall times and factors do. ``mapping`` is without start, dense model
and output; ``dense model and report`` is the share of all that comes after it. Factors are sensor time over wall time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_bringup.cli import slam
from slam_core.camera import Camera
from slam_core.messages import rectified_info

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data"))
OPTIONS = {
    "rig": ["--mode", "stereo"],
    "rig_full": ["--mode", "fuse", "--odometry", "ndt"],
    "mh01": ["--mode", "stereo"],
    "redkitchen": ["--mode", "tof"],
    "hololens": ["--mode", "tof"],
    "redkitchen_ndt": ["--mode", "tof", "--odometry", "ndt"],
    "hololens_ndt": ["--mode", "tof", "--odometry", "ndt"],
    "redkitchen_800": ["--mode", "tof"],
}
Row = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(OPTIONS)[:5], metavar="CASE")
    parser.add_argument("--against", type=Path, help="another checkout, the state before")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--frames", type=int, help="only so many frames of each recording")
    parser.add_argument("--keep", type=Path, help="folder for the bags")
    arguments = parser.parse_args()
    checkouts = {"here": ROOT} if arguments.against is None else {"before": arguments.against.resolve(), "here": ROOT}
    with tempfile.TemporaryDirectory() as scratch:
        for case in arguments.cases:
            bag = bag_of(case, arguments.keep or Path(scratch), arguments.frames)
            rows: dict[str, list[Row]] = {name: [] for name in checkouts}
            for _ in range(arguments.runs):
                for name, checkout in checkouts.items():
                    rows[name].append(one_run(checkout, bag, OPTIONS[case], Path(scratch)))
            show(f"{bag.stem}: {' '.join(OPTIONS[case])}, {arguments.runs} runs", rows)


def one_run(checkout: Path, bag: Path, options: list[str], scratch: Path) -> Row:
    """One ``slam run`` of a checkout in a process of its own."""
    report, output = (
        scratch / "cost.json",
        Path(tempfile.mkdtemp(dir=scratch)) / "out",
    )  # slam replaces no other's files
    packages = os.pathsep.join(str(p) for p in sorted((checkout / "src").iterdir()))
    script = str(Path(__file__).with_name("cost_of_run.py"))
    command = [sys.executable, script, str(report), str(bag), "-o", str(output), *options]
    began = time.perf_counter()
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": packages}, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - began
    if status:
        raise SystemExit(f"slam run of {checkout} failed: {' '.join(command)}")
    cpu, summary = json.loads(report.read_text()), json.loads((output / "summary.json").read_text())
    per_frame = 1e3 / summary["frames"]
    row = {f"{stage}, CPU ms/frame": per_frame * s for stage, s in cpu["stages"].items()}
    row["mapping, CPU ms/frame"] = per_frame * cpu["mapping"]
    row["start to exit, CPU ms/frame"] = per_frame * (usage.ru_utime + usage.ru_stime)
    row["dense model and report, %"] = 100.0 * (
        1.0 - (cpu["before"] + cpu["mapping"]) / (usage.ru_utime + usage.ru_stime)
    )
    row["mapping, x real time"] = summary["sensor_s"] / summary["wall_s"]
    row["start to exit, x real time"] = summary["sensor_s"] / wall_s
    row["peak memory, MiB"] = cpu["peak_mib"]
    for name, scale in (("frames", 1.0), ("landmarks", 1.0), ("ate_rmse_m", 1e3)):
        if summary.get(name) is not None:
            row[name if scale == 1.0 else "ATE, mm"] = scale * summary[name]
    return row


def show(title: str, rows: dict[str, list[Row]]) -> None:
    """A table of medians; with two checkouts also the median over runs of now over before."""
    table = Table(title=title)
    for heading in ("", *rows, *(["here / before"] if len(rows) > 1 else [])):
        table.add_column(heading, justify="right" if heading else "left")
    for name in dict.fromkeys(key for runs in rows.values() for run in runs for key in run):
        values = [np.array([run.get(name, np.nan) for run in runs]) for runs in rows.values()]
        ratio = [f"{np.median(values[1] / values[0]):.2f}"] if len(values) > 1 else []
        table.add_row(name, *(f"{np.median(v):.1f}" for v in values), *ratio)
    Console(width=120).print(table)


def bag_of(case: str, folder: Path, frames: int | None) -> Path:
    """The recording of a case, made where it is not there yet, with its first ``frames`` only."""
    name = "workshop_rig" if case.startswith("rig") else case.removesuffix("_ndt")
    whole = next((p for p in (folder / name, folder / f"{name}.mcap") if p.exists()), folder / f"{name}.mcap")
    if not whole.exists():
        MAKERS[name](whole)
    if frames is None:
        return whole
    cut = folder / f"{name}_first_{frames}.mcap"
    if not cut.exists():
        write_first(whole, cut, frames)
    return cut


def write_first(source: Path, target: Path, frames: int) -> None:
    """The part of a bag up to its n-th picture of the first of its cameras."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        types = {name: info.type_name for name, info in reader.topics.items()}
        camera = next(name for name, kind in types.items() if kind.endswith("Image"))
        last = [m.stamp_ns for m in reader.raw([camera])][:frames][-1]
        for topic, stamp_ns, data in reader.raw():
            if stamp_ns <= last:
                writer.write_raw(topic, types[topic], data, stamp_ns)


def make_rig(target: Path) -> None:
    slam(["simulate", "workshop_rig", "--profile", "ideal", "-o", str(target)], standalone_mode=False)


def make_mh01(target: Path) -> None:
    source = DATA / "euroc_mh01_10hz"
    truth = str(source / "truth_body_imu.txt")
    slam(["convert", "euroc", str(source), "-o", str(target), "--ground-truth", truth], standalone_mode=False)


def make_redkitchen(target: Path) -> None:
    slam(["convert", "rgbd", str(DATA / "rgbd_tsdf_1000" / "data"), "-o", str(target)], standalone_mode=False)


def make_redkitchen_800(target: Path) -> None:
    """Forwards and backwards, twice."""
    source = DATA / "rgbd_tsdf_1000" / "data"
    stems = [path.name.removesuffix(".depth.png") for path in sorted(source.glob("frame-*.depth.png"))]
    with tempfile.TemporaryDirectory() as scratch:
        for number, stem in enumerate(2 * (stems + stems[::-1])):
            for path in source.glob(f"{stem}.*"):
                (Path(scratch) / f"frame-{number:06d}{path.name.removeprefix(stem)}").symlink_to(path)
        slam(["convert", "rgbd", scratch, "-o", str(target)], standalone_mode=False)


def make_hololens(target: Path) -> None:
    source = DATA / "hololens_office_120"
    with BagWriter(target) as bag:
        writer = SensorWriter(bag)
        for number, (depth, grey) in enumerate(hololens_pictures(source)):
            stamp_ns = 10**9 + number * 10**8
            if number == 0:
                K = np.loadtxt(source / "K.txt")
                camera = Camera(depth.shape[1], depth.shape[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2])
                info = rectified_info(camera)
                writer.extrinsics(stamp_ns, {LEFT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_OPTICAL})
            writer.depth(stamp_ns, depth, info, measurement="depth", amplitude=grey)


def hololens_pictures(source: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Depth (mm) and grey picture of every frame."""
    for path in sorted((source / "depth").glob("*.png")):
        picture = cv2.imread(str(source / "images" / path.name), cv2.IMREAD_GRAYSCALE)
        yield np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)), np.asarray(picture)


MAKERS: dict[str, Callable[[Path], None]] = {
    "workshop_rig": make_rig,
    "mh01": make_mh01,
    "redkitchen": make_redkitchen,
    "redkitchen_800": make_redkitchen_800,
    "hololens": make_hololens,
}

if __name__ == "__main__":
    main()
