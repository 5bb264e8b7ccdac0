# SPDX-License-Identifier: Apache-2.0
"""Variants of a recording: the same pictures later, fewer, backwards, worse. Each is a bag that any program can read.

Pictures, depth, IMU, mounting, ground truth and the bag's ``calibration.yaml`` are kept; colours, wheels, laser scans
and masks are not. Backwards, stamps are mirrored, turn rates and known times negated; accelerations stay as they are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml

from slam_bags.reading.readings import AgentSensors, DepthReading, ImuReading, Reading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.bag_calibration import calibration_file
from slam_bags.storage.sensor_writer import IMU_FRAME, LEFT_FRAME, TOF_FRAME, SensorWriter
from slam_bringup.pipeline.overrides import read_overrides
from slam_core.camera import CameraInfo
from slam_core.trajectory import Trajectory
from slam_core.types import AnyArray

AS_IT_IS = "as it is"
_FIRST = 7
_QUALITY = 50
_GAMMA = 0.6
_GAP_S = 3.0
_GAP_AT = 0.4
_TIMES = ("measurement.readout", "imu.time_offset", "pair.time_offset")
"""Parameters of a calibration that change their sign when time runs backwards."""
_SAME_SURFACE = 0.02
"""Pixels whose depths differ by a larger share are not averaged."""


@dataclass(frozen=True, eq=False)
class _Rig:
    """Camera infos of a rig, None where there is no such camera."""

    left: CameraInfo | None
    right: CameraInfo | None
    tof: CameraInfo | None


def write_variant(source: Path, target: Path, variant: str) -> int:
    """Write a variant of a bag of one agent; the number of its frames.

    Raises
    ------
    ValueError
        If no frame is left, the bag has no ground truth, or its ``calibration.yaml`` is none.
    """
    calibration = _calibration_of(source, is_backwards=variant == "backwards")
    with SensorBag(source) as bag, BagWriter(target, calibration=calibration) as written:
        agent = bag.agents[0]
        sensors, truth = bag.sensors[agent], bag.ground_truth(agent)
        if truth is None:
            raise ValueError(f"{source} has no ground truth")
        readings: Iterable[Reading] = bag.readings()
        if variant == "backwards":
            readings, truth = _backwards(list(readings), truth)
        elif variant in _FEWER:
            readings = _FEWER[variant](list(readings))
        rig = _Rig(sensors.left, sensors.right, sensors.tof)
        if variant == "half resolution":
            rig = _Rig(*(None if info is None else _halved_info(info) for info in (rig.left, rig.right, rig.tof)))
        return _write(SensorWriter(written), sensors, rig, readings, truth, _PICTURES.get(variant, _unchanged))


def _calibration_of(source: Path, *, is_backwards: bool) -> str:
    """The file of a bag's calibration as YAML, "" if it has none."""
    file = calibration_file(source)
    if not file.is_file():
        return ""
    rules = {node: {"ros__parameters": values} for node, values in read_overrides(file).rules}
    for values in (rule["ros__parameters"] for rule in rules.values() if is_backwards):
        values |= {name: -v for name, v in values.items() if name in _TIMES and isinstance(v, int | float)}
    return str(yaml.safe_dump(rules, sort_keys=False))


# ---- fewer frames
def _from_later_on(readings: Sequence[Reading]) -> Iterator[Reading]:
    stamps = sorted({r.stamp_ns for r in readings if is_frame(r)})
    return (r for r in readings if len(stamps) > _FIRST and r.stamp_ns >= stamps[_FIRST])


def _every(step: int) -> Callable[[Sequence[Reading]], Iterator[Reading]]:
    def chosen(readings: Sequence[Reading]) -> Iterator[Reading]:
        seen: Counter[type[Reading]] = Counter()  # each camera by itself
        for reading in readings:
            if not is_frame(reading) or seen[type(reading)] % step == 0:
                yield reading
            seen[type(reading)] += 1

    return chosen


def _with_gap(readings: Sequence[Reading]) -> Iterator[Reading]:
    """Without the frames of three seconds; the IMU goes on."""
    stamps = [r.stamp_ns for r in readings if is_frame(r)]
    if not stamps:
        return iter(())
    begin = stamps[0] + _GAP_AT * (stamps[-1] - stamps[0])
    return (r for r in readings if not is_frame(r) or not begin <= r.stamp_ns < begin + 1e9 * _GAP_S)


def is_frame(reading: Reading) -> bool:
    """True for the pictures of a camera."""
    return isinstance(reading, StereoReading | DepthReading)


_FEWER: dict[str, Callable[[Sequence[Reading]], Iterator[Reading]]] = {
    f"from frame {_FIRST}": _from_later_on,
    "every second": _every(2),
    "every third": _every(3),
    "gap of 3 s": _with_gap,
}


# ---- backwards
def _backwards(readings: list[Reading], truth: Trajectory) -> tuple[Iterator[Reading], Trajectory]:
    if not readings:
        return iter(()), truth
    stamps = [r.stamp_ns for r in readings]
    last = max([*stamps, *truth.stamps_ns.tolist()])  # truth may go on after the recording, and no time is below 0
    turn = min(stamps) + last
    mirrored = Trajectory(turn - truth.stamps_ns[::-1], truth.poses[::-1])
    return (_mirrored(r, turn) for r in reversed(readings)), mirrored


def _mirrored(reading: Reading, turn: int) -> Reading:
    match reading:
        case StereoReading():
            return replace(reading, pair=replace(reading.pair, stamp_ns=turn - reading.stamp_ns))
        case DepthReading():
            return replace(reading, raw=replace(reading.raw, stamp_ns=turn - reading.stamp_ns))
        case ImuReading():
            sample = reading.sample
            turned = replace(sample, stamp_ns=turn - sample.stamp_ns, angular_velocity=-sample.angular_velocity)
            return replace(reading, sample=turned)
    return reading


# ---- worse pictures: of a picture, or of a depth image
def _unchanged(image: AnyArray, is_depth: bool) -> AnyArray:
    del is_depth
    return image


def _compressed(image: AnyArray, is_depth: bool) -> AnyArray:
    if is_depth or image.dtype != np.uint8:
        return image
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def _brightened(image: AnyArray, is_depth: bool) -> AnyArray:
    if is_depth or image.dtype != np.uint8:
        return image
    table = np.round(255.0 * (np.arange(256) / 255.0) ** _GAMMA).astype(np.uint8)
    return np.asarray(table[image])


def _halved(image: AnyArray, is_depth: bool) -> AnyArray:
    """Means of two by two pixels; of depths where all four are on one surface, else none."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    four = image[: 2 * height, : 2 * width]
    if not is_depth:
        return np.asarray(cv2.resize(four, (width, height), interpolation=cv2.INTER_AREA))
    parts = four.astype(np.float64).reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    low, high = parts.min(axis=2), parts.max(axis=2)
    mean = np.where((low > 0.0) & (high - low <= _SAME_SURFACE * low), parts.mean(axis=2), 0.0)
    return np.round(mean).astype(image.dtype) if image.dtype == np.uint16 else mean.astype(image.dtype)


def _halved_info(info: CameraInfo) -> CameraInfo:
    """The camera of means of two by two pixels."""
    c, P = info.camera, info.P.copy()
    P[:2] *= 0.5
    P[:2, 2] -= 0.25
    camera = replace(
        c, width=c.width // 2, height=c.height // 2, fx=0.5 * c.fx, fy=0.5 * c.fy, cx=0.5 * c.cx - 0.25,
        cy=0.5 * c.cy - 0.25,
    )  # fmt: skip
    return CameraInfo(camera, info.R, P)


_Change = Callable[[AnyArray, bool], AnyArray]
_PICTURES: dict[str, _Change] = {
    f"JPEG quality {_QUALITY}": _compressed,
    f"gamma {_GAMMA}": _brightened,
    "half resolution": _halved,
}

VARIANTS = (AS_IT_IS, *_FEWER, "backwards", *_PICTURES)
"""Names of all variants."""


# ---- writing
def _write(
    writer: SensorWriter, sensors: AgentSensors, rig: _Rig, readings: Iterable[Reading], truth: Trajectory,
    change: _Change,
) -> int:  # fmt: skip
    frames, first = 0, 0
    for reading in readings:
        if not first:
            first = reading.stamp_ns
            _mount(writer, sensors, first)
        frames += is_frame(reading)
        _write_reading(writer, sensors, rig, reading, change)
    if not frames:
        raise ValueError("no frame is left in this variant: the recording is too short")
    for stamp, T in zip(truth.stamps_ns, truth.poses, strict=True):
        writer.ground_truth(int(stamp), T)
    return frames


def _mount(writer: SensorWriter, sensors: AgentSensors, stamp_ns: int) -> None:
    mounts = {}
    for frame, camera in ((LEFT_FRAME, "left"), (TOF_FRAME, "tof")):
        if sensors.is_mounted(camera):
            mounts[frame] = sensors.transform("base", camera)
    if IMU_FRAME in sensors.frames:
        mounts[IMU_FRAME] = sensors.frames.lookup(sensors.base_frame, IMU_FRAME)
    writer.extrinsics(stamp_ns, mounts)


def _write_reading(writer: SensorWriter, sensors: AgentSensors, rig: _Rig, reading: Reading, change: _Change) -> None:
    match reading:
        case StereoReading(pair=pair) if rig.left is not None and rig.right is not None:
            images = (change(pair.left, False), change(pair.right, False))
            writer.stereo(pair.stamp_ns, *images, (rig.left, rig.right))
        case DepthReading(raw=raw) if rig.tof is not None:
            beside = {"amplitude": raw.amplitude, "intensity": raw.intensity}
            pictures = {name: None if image is None else change(image, False) for name, image in beside.items()}
            depth = change(raw.image, True)
            writer.depth(raw.stamp_ns, depth, rig.tof, measurement=sensors.measurement, **pictures)
        case ImuReading(sample=sample):
            writer.imu(sample)
