# SPDX-License-Identifier: Apache-2.0
"""``slam calibrate refine``: what a recording shows of its cameras without a board.

A stereo pair that is not quite rectified is corrected; the distortion of a depth camera's depth, the readout of a
rolling shutter, the time between the images of a pair and the difference of the IMU's clock and the images' are written
down, so that the next run knows them from its first frame on.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ekf_slam_node.stage import FilterStage
from slam_bags.reading.readings import DepthReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag_calibration import FILE_NAME, calibration_file
from slam_bringup.pipeline.configuration import choose, filter_config, load_system_config
from slam_bringup.pipeline.overrides import read_overrides
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline, depth_stage
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.camera import CameraInfo
from slam_core.camera_info import CameraInfoFile
from slam_core.storage.files import atomic_text
from slam_core.types import Features, ImuSample
from stereo_frontend.depth.plane_evidence import DistortionEstimate, PlaneEvidence
from stereo_frontend.frontend_config import FrontendReport
from stereo_frontend.stereo.corrected_info import corrected_right

_TIMES = (
    ("rows are read out within", "measurement.readout", "measurement.sigma_readout"),
    ("to be added to the IMU's stamps:", "imu.time_offset", "imu.sigma_time_offset"),
    ("the right image is taken later by", "pair.time_offset", "pair.sigma_time_offset"),
)
"""Words for a finding, and its parameters of the nodes."""
_DISTORTION = {"columns": "x", "rows": "y"}
"""Coordinate in whose square each number of the depth's distortion grows."""
_IMAGE_EVERY_NS, _MOST_IMAGES = 150_000_000, 200
"""Depth images whose walls are looked at, ns apart: those between show the same walls."""


@dataclass(frozen=True)
class Refined:
    """Findings of a recording: its cameras' infos, corrected or as they were, the nodes' parameters, figures."""

    infos: Mapping[str, CameraInfo]
    is_corrected: bool
    parameters: Mapping[str, float]
    figures: Mapping[str, Any]

    def description(self) -> str:
        """Findings as a line each."""
        found, f = [], self.figures
        if self.is_corrected:
            found.append(
                f"rows were off by {f['row_error_px']:.2f} px, disparities by {f['disparity_error_px']:.2f} +- "
                f"{f['disparity_error_sigma_px']:.2f} px: corrected"
            )
        for text, name, sigma_name in _TIMES:
            if name in self.parameters:
                value, sigma = (1e3 * self.parameters[key] for key in (name, sigma_name))
                found.append(f"{text} {value:.1f} +- {sigma:.1f} ms: {FILE_NAME}")
        for name in (n for n in _DISTORTION if f"depth_distortion.{n}" in self.parameters):
            value, sigma = (100.0 * self.parameters[f"depth_distortion.{key}"] for key in (name, f"sigma_{name}"))
            found.append(
                f"depth is bent along {name} by {value:.1f} +- {sigma:.1f} % per ({_DISTORTION[name]}/z)^2: {FILE_NAME}"
            )
        return "\n".join(found)


def refine(bag: Path) -> Refined:
    """Findings of the first agent's images about its cameras.

    Raises
    ------
    ValueError
        If the bag has no camera infos, or shows nothing to correct.
    """
    with SensorBag(bag) as source:
        agent = source.agents[0]
        mode = "stereo" if source.count(agent, "left") else "tof"
        sensors = source.sensors[agent]
        infos = {"left": sensors.left, "right": sensors.right} if mode == "stereo" else {"tof": sensors.tof}
        known = {name: info for name, info in infos.items() if info is not None}
        if len(known) < len(infos):
            raise ValueError(f"{bag} has images without camera infos: calibrate with a board first")
        report, parameters = _learnt(source, agent, mode)
        distortion = _distortion(source, agent) if sensors.tof is not None else {}
    figures = {**report.rectification, **parameters, **distortion}
    parameters |= {name: value for name, value in distortion.items() if name.startswith("depth_distortion.")}
    if report.correction is None and not parameters:
        raise ValueError(f"the images show no significant error to correct: {figures}")
    if report.correction is not None:
        known["right"], figures["left_over_px"] = corrected_right(known["right"], report.correction)
    return Refined(known, report.correction is not None, parameters, figures)


def _learnt(source: SensorBag, agent: str, mode: str) -> tuple[FrontendReport, dict[str, float]]:
    """Findings of the front end, and times as the filters learn them; none where they see none.

    One filter has the images alone, as the rolling shutter is seen best, another one the IMU as well.
    """
    sensors = replace(source.sensors[agent], camera="")  # a camera of several is looked at for itself
    alone, aided = (choose(load_system_config(None), mode, "ekf", "none", imu) for imu in ("off", "auto"))
    pipeline = SensorPipeline(aided, sensors, False, StageTimes())
    stages = [
        FilterStage(filter_config(system.ekf_slam, sensors), sensors.frames, sensors.base_frame)
        for system in (alone, aided)[: 1 + ("imu" in sensors.topics)]
    ]
    for reading in source.readings():
        items = pipeline.add(reading) if reading.agent == agent else iter(())
        for value in (pipeline.measure(item).value for item in items):
            for stage in stages:
                if isinstance(value, Features):
                    stage.add_features(value)
                elif isinstance(value, ImuSample) and stage is not stages[0]:
                    stage.add_imu(value)
                for _ in stage.ready():
                    pass
    front_end = pipeline.front_end()
    found = (stages[0].readout_s, stages[-1].imu_time_offset_s, front_end.right_late_s)
    learnt = [zip(names, times, strict=True) for (_, *names), times in zip(_TIMES, found, strict=True) if times[0]]
    return front_end, {name: value for times in learnt for name, value in times}


def _distortion(source: SensorBag, agent: str) -> dict[str, float]:
    """Parameters of the depth's distortion that is sure, and figures of what the walls tell."""
    stage = depth_stage(load_system_config(None), source.sensors[agent])
    every = -(-source.count(agent, "depth") // _MOST_IMAGES)  # of the whole recording
    evidence, newest, images = PlaneEvidence(np.random.default_rng(0)), -_IMAGE_EVERY_NS, 0
    for reading in source.readings():
        if not isinstance(reading, DepthReading) or reading.agent != agent:
            continue
        images += 1
        if (images - 1) % every or abs(reading.stamp_ns - newest) < _IMAGE_EVERY_NS:
            continue
        newest = reading.stamp_ns
        stage.add(reading.raw)
        for image in stage.ready():
            evidence.add(image)
    return _distortion_figures(evidence.estimate())


def _distortion_figures(found: DistortionEstimate) -> dict[str, float]:
    figures: dict[str, float] = {"planes": found.planes}
    for j, name in enumerate(_DISTORTION):
        figures |= {
            f"depth_bend_{name}": float(found.measured[j]),
            f"depth_bend_sigma_{name}": float(found.sigma[j]),
            f"depth_bend_{name}_is_observable": bool(found.is_observable[j]),
        }
        if found.is_corrected[j]:
            figures[f"depth_distortion.{name}"] = float(found.values[j])
            figures[f"depth_distortion.sigma_{name}"] = float(found.sigma[j])
    return figures


def write_refined(folder: Path, bag: Path, found: Refined) -> None:
    """Write a calibration: the cameras, ``calibration.yaml`` with what the bag's own says, ``summary.json``."""
    for name, info in found.infos.items():
        CameraInfoFile(info, name).write(folder / f"{name}.yaml")
    own = calibration_file(bag)
    known = read_overrides(own).of_all if own.is_file() else {}
    if parameters := known | dict(found.parameters):
        document = {"/**": {"ros__parameters": parameters}}
        atomic_text(folder / FILE_NAME, yaml.safe_dump(document, sort_keys=False))
    atomic_text(folder / "summary.json", json.dumps(found.figures, indent=2) + "\n")
