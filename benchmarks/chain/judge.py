# SPDX-License-Identifier: Apache-2.0
"""The judge of a change: every recording in variants of its pictures, ours beside ORB-SLAM3 and SIFT + PnP.

    python benchmarks/chain/judge.py [NAME | BAG ...] --keep FOLDER [--variants VARIANT ...]
        [--orbslam3 VENV/bin/python] [--json FILE]

NAME: as in ``recordings.py``. A variant is a bag of its own in the folder, so that all methods get the same pictures:
a later start, every second picture, backwards, JPEG quality 50, gamma 0.6, a gap of 3 s in the middle, half the
resolution; the IMU is left out. Per recording and method: median and worst ATE (mm) and share of the frames with a pose
over the variants. ORB-SLAM3 stereo as in ``orbslam3.py``, on recordings of a pair, where its interpreter is named. A
change is kept if the geometric mean of our medians, the last line, falls, and no recording gets worse by a tenth.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from orbslam3 import peer
from recordings import RECORDINGS, Recording, Row, _pnp, row_of
from rich.console import Console
from rich.table import Table

from slam_bringup.bags.bag import BagWriter
from slam_bringup.bags.readings import AgentSensors, DepthReading, Reading, StereoReading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.bags.sensor_writer import LEFT_FRAME, RIGHT_FRAME, TOF_FRAME, SensorWriter
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.camera import CameraInfo
from slam_core.geometry import make_transform
from slam_core.types import AnyArray

VARIANTS = ("as it is", "from 7", "every second", "backwards", "jpeg 50", "gamma 0.6", "gap 3 s", "half size")
_HALVED = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    present = [name for name, recording in RECORDINGS.items() if Path(recording.source[1]).exists()]
    parser.add_argument("names", nargs="*", default=present, metavar="NAME")
    parser.add_argument("--variants", nargs="*", default=VARIANTS, choices=VARIANTS, metavar="VARIANT")
    parser.add_argument("--keep", type=Path, required=True, help="folder for bags and results")
    parser.add_argument("--orbslam3", help="interpreter that has orbslam3-python")
    parser.add_argument("--json", type=Path, help="write every row there")
    arguments = parser.parse_args()
    arguments.keep.mkdir(parents=True, exist_ok=True)
    table, rows, medians = Table(title="recordings in variants"), [], []
    for heading in ("recording", "method", "variants", "ATE mm: median", "worst", "of the frames: median", "worst"):
        table.add_column(heading, justify="left" if heading in ("recording", "method") else "right")
    for name in arguments.names:
        found: dict[str, list[Row]] = {}
        for variant in arguments.variants:
            for method, row in _rows(name, variant, arguments.keep, arguments.orbslam3):
                found.setdefault(method, []).append(row)
                rows.append(asdict(row) | {"method": method, "variant": variant})
                print(
                    f"{name}, {variant}, {method}: {row.ate_mm:.1f} mm, {row.frames} poses", file=sys.stderr, flush=True
                )
        most = [max(r.frames for r in group) for group in zip(*found.values(), strict=True)]
        for method, group in found.items():
            ate, share = [r.ate_mm for r in group], [r.frames / n for r, n in zip(group, most, strict=True)]
            figures = [f"{np.median(ate):.1f}", f"{max(ate):.1f}", f"{np.median(share):.2f}", f"{min(share):.2f}"]
            table.add_row(Path(name).stem, method, str(len(group)), *figures)
        medians.append(float(np.median([r.ate_mm for r in found["ours"]])))
    Console(width=120).print(table)
    print(f"geometric mean of our medians: {np.exp(np.mean(np.log(medians))):.2f} mm")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


def _rows(name: str, variant: str, folder: Path, orbslam3: str | None) -> Iterator[tuple[str, Row]]:
    """Our row and those of the peers on one variant."""
    recording = RECORDINGS.get(name, Recording(("bag", Path(name)), "stereo", ("alone",), ""))
    whole = folder / f"{name}.mcap" if name in RECORDINGS else Path(name)
    if not whole.exists():
        slam(["convert", *map(str, recording.source), "-o", str(whole)], standalone_mode=False)
    stem = f"{Path(name).stem}_{variant.replace(' ', '_')}"
    bag = folder / f"{stem}.mcap"
    if not bag.exists():
        write_variant(whole, variant, bag)
    yield "ours", _ours(name, bag, recording)
    yield "SIFT + PnP", _pnp(name, bag, recording)
    if orbslam3 and recording.mode == "stereo":
        pictures = folder / f"{stem}_pictures"
        pictures.mkdir(exist_ok=True)
        poses, ate, scale, ms = peer(bag, pictures, orbslam3)[1:]
        yield (
            "ORB-SLAM3",
            Row(name, "ORB-SLAM3", int(poses), float(ate), 0.0, float(scale), None, None, None, 0, float(ms)),
        )


def _ours(name: str, bag: Path, recording: Recording) -> Row:
    """Our row, without the dense model."""
    system = choose(load_system_config(None, bag), recording.mode, "sjsam", "none", "off")
    system = replace(system, dense_mapper=replace(system.dense_mapper, use_stereo=False, use_tof=False))
    result, _ = run_bag(bag, system)
    agent, lost = result.agents[0], result.rejections.get("frames_lost", 0)
    return row_of(name, "ours", agent.trajectory, agent.truth, recording.truth, lost, None)


# ---- variants
def write_variant(whole: Path, variant: str, path: Path) -> None:
    """Write the bag of a variant."""
    with SensorBag(whole) as bag, BagWriter(path) as written:
        agent = bag.agents[0]
        sensors, writer = bag.sensors[agent], SensorWriter(written)
        readings = [r for r in bag.readings() if isinstance(r, StereoReading | DepthReading) and r.agent == agent]
        truth = bag.ground_truth(agent)
        turn = readings[0].stamp_ns + readings[-1].stamp_ns
        backwards = variant == "backwards"
        chosen = list(_chosen(readings, variant))
        stamp = {id(r): turn - r.stamp_ns if backwards else r.stamp_ns for r in chosen}
        chosen.sort(key=lambda r: stamp[id(r)])
        writer.extrinsics(stamp[id(chosen[0])], _extrinsics(sensors))
        for reading in chosen:
            _write(writer, reading, stamp[id(reading)], sensors, variant)
        if truth is not None:
            for t, T in sorted(
                zip(truth.stamps_ns.tolist(), truth.poses, strict=True), key=lambda p: p[0] * (1 - 2 * backwards)
            ):
                writer.ground_truth(turn - t if backwards else t, T)


def _chosen(readings: list[Reading], variant: str) -> Iterator[Reading]:
    """The pictures of a variant; the readings of one stamp stay together."""
    stamps = sorted({r.stamp_ns for r in readings})
    middle = 0.5e-9 * (stamps[0] + stamps[-1])
    for r in readings:
        k = stamps.index(r.stamp_ns)
        is_late = variant != "from 7" or k >= 7
        is_second = variant == "every second" and k % 2
        is_in_gap = variant == "gap 3 s" and abs(1e-9 * r.stamp_ns - middle) < 1.5
        if is_late and not is_second and not is_in_gap:
            yield r


def _extrinsics(sensors: AgentSensors) -> dict[str, np.ndarray]:
    frames = {}
    if sensors.left is not None and sensors.right is not None:
        frames[LEFT_FRAME] = sensors.transform("base", "left")
        baseline = -sensors.right.P[0, 3] / sensors.right.P[0, 0]
        frames[RIGHT_FRAME] = frames[LEFT_FRAME] @ make_transform(np.eye(3), np.array([baseline, 0.0, 0.0]))
    if sensors.tof is not None:
        frames[TOF_FRAME] = sensors.transform("base", "tof")
    return frames


def _write(writer: SensorWriter, reading: Reading, stamp_ns: int, sensors: AgentSensors, variant: str) -> None:
    is_half = variant == "half size"
    if isinstance(reading, StereoReading):
        infos = tuple(_halved(i) if is_half else i for i in (sensors.left, sensors.right))
        left, right = (_picture(p, variant) for p in (reading.pair.left, reading.pair.right))
        writer.stereo(stamp_ns, left, right, infos)
    elif isinstance(reading, DepthReading):
        raw = reading.raw
        image = raw.image[::2, ::2] if is_half else raw.image
        pictures = {name: None if p is None else _picture(p, variant) for name, p in
                    (("amplitude", raw.amplitude), ("intensity", raw.intensity))}  # fmt: skip
        info = _halved(sensors.tof) if is_half else sensors.tof
        writer.depth(stamp_ns, np.ascontiguousarray(image), info, measurement=sensors.measurement, **pictures)


def _picture(image: AnyArray, variant: str) -> AnyArray:
    """A picture as the variant has it; grey values of other types than uint8 keep theirs."""
    if variant == "half size":  # at every second pixel, so that a depth image stays in its pixels
        return np.ascontiguousarray(cv2.GaussianBlur(image, (0, 0), 0.8)[::2, ::2])
    if image.dtype != np.uint8:
        return image
    if variant == "jpeg 50":
        return np.asarray(
            cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 50])[1], cv2.IMREAD_UNCHANGED)
        )
    if variant == "gamma 0.6":
        return np.asarray(cv2.LUT(image, (255.0 * (np.arange(256) / 255.0) ** 0.6).round().astype(np.uint8)))
    return image


def _halved(info: CameraInfo) -> CameraInfo:
    """Camera info of every second pixel."""
    c, P = info.camera, info.P.copy()
    P[:2] *= _HALVED
    camera = replace(
        c, width=(c.width + 1) // 2, height=(c.height + 1) // 2, fx=_HALVED * c.fx, fy=_HALVED * c.fy,
        cx=_HALVED * c.cx, cy=_HALVED * c.cy,
    )  # fmt: skip
    return CameraInfo(camera, info.R, P)


if __name__ == "__main__":
    main()
