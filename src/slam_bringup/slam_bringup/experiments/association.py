# SPDX-License-Identifier: Apache-2.0
"""Sections 4.2 to 4.5: which features belong to which landmarks, by nearest neighbour or by Mahalanobis distance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ekf_slam_node.association import associate_jcbb, associate_mahalanobis, associate_nearest
from ekf_slam_node.candidates import Candidates
from ekf_slam_node.config import FeatureAssociationConfig
from ekf_slam_node.models import Frame, frame_from_features, rig_points
from slam_bringup.experiments.chain import Kept
from slam_bringup.experiments.findings import Comparison, Experiment, Findings, Table
from slam_bringup.experiments.job import RENDERING, Job, JobResult
from slam_core.geometry import FloatArray, invert_transform
from slam_simulation import Scenario
from slam_simulation.feature_level import FeatureFrame, FeatureSimulator

MODULE = "slam_bringup.experiments.association"
_NO_DESCRIPTORS: dict[str, Any] = {"descriptor_threshold": -1.0, "descriptor_weight": 0.0}
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "Algorithm 1: nearest": ("nearest", _NO_DESCRIPTORS),
    "Algorithm 1 + descriptors": ("nearest", {}),
    "Algorithm 2: Mahalanobis": ("mahalanobis", _NO_DESCRIPTORS),
    "Algorithm 2 + descriptors": ("mahalanobis", {}),
    "JCBB, of 20 features": ("jcbb", _NO_DESCRIPTORS),
    "JCBB, of 20 features + descriptors": ("jcbb", {}),
}
_RATES = (10, 5, 2)
_SIGMA_MOTION = np.repeat([3.0, 4.0], 3)
"""Accelerations of the constant-velocity model, m/s2 and rad/s2."""


def associate(folder: Path, before: list[Path], method: str, every: int, frames: int) -> Kept:
    """Precision and recall of one method on a scenario's feature-level simulation, every n-th frame."""
    algorithm, overrides = METHODS[method]
    config = replace(FeatureAssociationConfig(), method=algorithm, **overrides)
    simulator = FeatureSimulator(Scenario.load("workshop_handheld"))
    views = [simulator.frame(k * every) for k in range(frames)]
    dt = every / simulator.scenario.rate
    right = paired = common = 0
    for k in range(2, frames):
        first, second = views[k - 1], views[k]
        step = invert_transform(views[k - 2].T_world_rig) @ first.T_world_rig  # constant velocity
        rows, columns = _pairs(first, second, step, dt, simulator.T_rig_left, config)
        common += len(np.intersect1d(first.ids, second.ids))
        paired += len(rows)
        right += int((first.ids[rows] == second.ids[columns]).sum())
    return {"precision": right / max(paired, 1), "recall": right / max(common, 1)}, {}


def _pairs(
    first: FeatureFrame, second: FeatureFrame, step: FloatArray, dt: float, T_rig_optical: FloatArray,
    config: FeatureAssociationConfig,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:  # fmt: skip
    """Candidates of the first frame and features of the second that the method pairs."""
    before, now = _frame(first), _frame(second)
    candidates = Candidates(*rig_points(before, T_rig_optical), before.descriptors)
    similarity = np.asarray(candidates.descriptors @ now.descriptors.T, dtype=np.float64)
    if config.method == "nearest":
        rows, columns = associate_nearest(candidates, now, step, T_rig_optical, config.nearest_associate)
        alike = similarity[rows, columns] >= config.descriptor_threshold
        return rows[alike], columns[alike]
    covariance = np.diag((0.5 * dt**2 * _SIGMA_MOTION) ** 2)
    method = associate_jcbb if config.method == "jcbb" else associate_mahalanobis
    return method(candidates, now, similarity, step, covariance, T_rig_optical, config)


def _frame(view: FeatureFrame) -> Frame:
    return frame_from_features(view.features, np.arange(len(view.features)), 0.01, 1e-5)


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        frames = 15 if quick else 60
        packages = (*RENDERING, "ekf_slam_node")
        return {
            f"{method}, {rate} Hz": Job(
                f"{MODULE}:associate", {"method": method, "every": 10 // rate, "frames": frames}, packages
            )
            for method in METHODS for rate in _RATES
        }  # fmt: skip

    def report(results: Mapping[str, JobResult]) -> Findings:
        rows = [
            [method, *(f"{results[f'{method}, {rate} Hz'].values[key]:.3f}" for rate in _RATES
                       for key in ("precision", "recall"))]
            for method in METHODS
        ]  # fmt: skip
        f = {
            name: 2 * v["precision"] * v["recall"] / max(v["precision"] + v["recall"], 1e-9)
            for name, v in ((name, r.values) for name, r in results.items())
        }
        nearest, mahalanobis = f["Algorithm 1: nearest, 10 Hz"], f["Algorithm 2: Mahalanobis, 10 Hz"]
        header = ("method", *(f"{key}, {rate} Hz" for rate in _RATES for key in ("precision", "recall")))
        return Findings(
            [Comparison("harmonic mean of precision and recall, nearest and Mahalanobis, 10 Hz",
                        "both map; Mahalanobis closes loops better", f"{nearest:.3f}, {mahalanobis:.3f}",
                        "Mahalanobis higher", mahalanobis > nearest)],
            [Table("Frame to frame, against the true association", header, rows)],
        )  # fmt: skip

    return Experiment("association", "4.2-4.5", "Nearest neighbour against Mahalanobis distance", jobs, report)


EXPERIMENTS = (_experiment(),)
