# SPDX-License-Identifier: Apache-2.0
"""Maps a bag for what the trajectory and the map say: without the dense model, which takes as long again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slam_bringup.pipeline.configuration import SystemConfig, choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_viewer.results import RunResult


def without_dense_model(config: SystemConfig) -> SystemConfig:
    return replace(config, dense_mapper=replace(config.dense_mapper, use_stereo=False, use_tof=False))


def quick_options(folder: Path) -> tuple[str, str]:
    """Options of ``slam run`` for a run without a dense model; ``folder`` takes the file that they name."""
    path = folder / "without_dense_model.yaml"
    path.write_text("dense_mapper: {use_stereo: false, use_tof: false}\n")
    return "--config", str(path)


def mapped(bag: Path, mode: str = "stereo", odometry: str = "none", imu: str | None = None) -> RunResult:
    """The result of a bag by default parameters, without a dense model."""
    config = choose(load_system_config(None), mode, "sjsam", odometry, imu)
    return run_bag(bag, without_dense_model(config), odometry=odometry)[0]
