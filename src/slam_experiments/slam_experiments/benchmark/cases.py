# SPDX-License-Identifier: Apache-2.0
"""Cases of the benchmark as jobs: a recording, a variant of it, and a program that maps this."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag_calibration import calibration_file
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.storage.files import read_json
from slam_core.trajectory import Trajectory
from slam_experiments.benchmark.figures import figures_of
from slam_experiments.benchmark.orbslam3 import orbslam3
from slam_experiments.benchmark.recording_sets import RecordingSet
from slam_experiments.benchmark.variants import AS_IT_IS, write_variant
from slam_experiments.benchmark.visual_odometry import frame_to_frame
from slam_experiments.job import EVERYTHING, VALUES, Job, Kept

MODULE = "slam_experiments.benchmark.cases"
OURS = "ours"
PNP = "SIFT + PnP"
ORBSLAM3 = "ORB-SLAM3"
_BAGS = ("slam_core.camera", "slam_core.geometry", "slam_core.messages", "slam_bags")
_OWN = "slam_experiments.benchmark"
_FIGURES = (f"{_OWN}.figures", f"{_OWN}.truth")
_BAG = "bag.mcap"


@dataclass(frozen=True)
class Case:
    """``program`` maps ``variant`` of a recording; ``run``: of ours, how ("alone", "ndt", "imu"), else ""."""

    recording: str
    variant: str
    program: str
    run: str
    job: Job


def cases_of(
    recording: RecordingSet,
    variants: Sequence[str],
    *,
    config: str = "",
    peers: bool = False,
    orbslam3_python: str = "",
) -> Iterator[Case]:
    """All cases of a recording.

    ``config``: parameters of the nodes as YAML. ``peers``: others' programs too. ``orbslam3_python``: the interpreter
    that has ORB-SLAM3, "" where there is none.
    """
    common = {"mode": recording.mode, "truth": recording.truth}
    for variant in variants:
        bag = _bag_job(recording, variant)
        for run in recording.runs:
            arguments = {**common, "run": run, "config": config}
            yield Case(
                recording.name, variant, OURS, run, Job(f"{MODULE}:ours", arguments, (*EVERYTHING, *_FIGURES), (bag,))
            )
        if not peers:
            continue
        packages = (*_FIGURES, f"{_OWN}.visual_odometry")
        yield Case(recording.name, variant, PNP, "", Job(f"{MODULE}:pnp", common, packages, (bag,)))
        if orbslam3_python:
            needed = (*packages, f"{_OWN}.orbslam3", f"{_OWN}.orbslam3_program")
            arguments = {**common, "python": orbslam3_python}
            yield Case(recording.name, variant, ORBSLAM3, "", Job(f"{MODULE}:orbslam3_on", arguments, needed, (bag,)))


def _bag_job(recording: RecordingSet, variant: str) -> Job:
    whole = Job(f"{MODULE}:bag_of", {"recording": _as_text(recording)}, _BAGS)
    if variant == AS_IT_IS:
        return whole
    return Job(
        f"{MODULE}:variant_of",
        {"variant": variant},
        (*_BAGS, "slam_bringup.pipeline.overrides", f"{_OWN}.variants"),
        (whole,),
    )


def _as_text(recording: RecordingSet) -> dict[str, Any]:
    """Everything of a recording that its results depend on, as JSON knows it."""
    paths = {name: value for name, value in asdict(recording).items() if isinstance(value, Path)}
    state = _state_of([*paths.values(), calibration_file(recording.source)])
    places = {name: str(path) for name, path in paths.items()}
    return {"kind": recording.kind, "failed": recording.failed, **places, "state": state}


def _state_of(paths: Iterable[Path]) -> str:
    """Digest of all files at some places and below them; size and time stand for a file's content."""
    state = sha256()
    for path in paths:
        for file in sorted(f for f in (path, *path.rglob("*")) if f.is_file()):
            known = file.stat()
            state.update(f"{file.relative_to(path)} {known.st_size} {known.st_mtime_ns}\n".encode())
        state.update(b"\n")
    return state.hexdigest()[:16]


# ---- jobs
def bag_of(folder: Path, before: list[Path], recording: dict[str, Any]) -> Kept:
    """The bag of a recording: converted, or where it lies; or why there is none."""
    del before
    if recording["failed"]:
        return {"failed": recording["failed"]}, {}
    if not recording["kind"]:
        return {"bag": recording["source"]}, {}
    names = [name for name in ("source", "calibration", "ground_truth") if name in recording]
    paths: dict[str, Any] = {name: Path(recording[name]) for name in names}
    try:
        RecordingSet("", recording["kind"], mode="", runs=(), truth="", **paths).write_bag(folder / _BAG)
    except (ValueError, OSError) as error:
        return {"failed": str(error)}, {}
    return {"bag": ""}, {}


def variant_of(folder: Path, before: list[Path], variant: str) -> Kept:
    """A variant of the bag of the job before, or why there is none."""
    try:
        return {"bag": "", "frames": write_variant(_bag_in(before), folder / _BAG, variant)}, {}
    except ValueError as error:
        return {"failed": str(error)}, {}


def _bag_in(before: list[Path]) -> Path:
    """The bag that the job before made; ValueError if it could not."""
    values = read_json(before[0] / VALUES)
    if "failed" in values:
        raise ValueError(values["failed"])
    return Path(values["bag"] or before[0] / _BAG)


def ours(folder: Path, before: list[Path], mode: str, truth: str, run: str, config: str) -> Kept:
    """Our own chain: the joined map, and the filter alone."""
    (folder / "config.yaml").write_text(config, encoding="utf-8")
    odometry = "ndt" if run == "ndt" else "none"
    try:
        bag = _bag_in(before)
        given = load_system_config(folder / "config.yaml" if config else None, bag)
        system = choose(given, mode, "sjsam", odometry, "on" if run == "imu" else "off")
        system = replace(system, dense_mapper=replace(system.dense_mapper, use_stereo=False, use_tof=False))
        began = time.process_time()
        result, session = run_bag(bag, system, odometry=odometry)
    except ValueError as error:
        return {"failed": str(error)}, {}
    if result.failure:
        return {"failed": result.failure}, {}
    agent = result.agents[0]
    values = {
        "ms_per_frame": 1e3 * (time.process_time() - began) / max(result.frames, 1),
        "lost": result.rejections.get("frames_lost", 0),
        "parts": result.map.components,
        "contradiction": session.snapshot.overconfidence,
        "filter": _figures(agent.filtered, bag, mode, truth),
    }
    return values | _figures(agent.trajectory, bag, mode, truth), {}


def pnp(folder: Path, before: list[Path], mode: str, truth: str) -> Kept:
    """SIFT and PnP from frame to frame."""
    del folder
    try:
        bag = _bag_in(before)
        began = time.process_time()
        trajectory, lost = frame_to_frame(bag, mode)
    except (ValueError, RuntimeError, cv2.error) as error:
        return {"failed": str(error)}, {}
    ms = 1e3 * (time.process_time() - began) / max(len(trajectory), 1)
    return {"ms_per_frame": ms, "lost": lost} | _figures(trajectory, bag, mode, truth), {}


def orbslam3_on(folder: Path, before: list[Path], mode: str, truth: str, python: str) -> Kept:
    """ORB-SLAM3, stereo or RGB-D."""
    with TemporaryDirectory(dir=folder) as scratch:
        try:
            bag = _bag_in(before)
            trajectory, ms = orbslam3(bag, mode, "kitti" if truth == "kitti" else mode, python, Path(scratch))
        except (ValueError, RuntimeError, cv2.error) as error:
            return {"failed": str(error)}, {}
    return {"ms_per_frame": ms} | _figures(trajectory, bag, mode, truth), {}


def _figures(trajectory: Trajectory, bag: Path, mode: str, known: str) -> dict[str, Any]:
    """Figures by name, with the share of all frames that have a pose; what failed if there are none."""
    with SensorBag(bag) as opened:
        agent = opened.agents[0]
        truth = opened.ground_truth(agent)
        frames = opened.count(agent, "left" if mode == "stereo" else "depth")
    if truth is None:
        return {"failed": f"{bag} has no ground truth"}
    try:
        return {**asdict(figures_of(trajectory, truth, known)), "coverage": len(trajectory) / max(frames, 1)}
    except ValueError as error:
        return {"failed": str(error)}
