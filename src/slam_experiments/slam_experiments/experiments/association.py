# SPDX-License-Identifier: Apache-2.0
"""Sections 4.2 to 4.5: which features belong to which landmarks, by nearest neighbour or by Mahalanobis distance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ekf_slam_node.association.association import (
    associate_ccda,
    associate_jcbb,
    associate_mahalanobis,
    associate_nearest,
)
from ekf_slam_node.config import FeatureAssociationConfig
from ekf_slam_node.filtering.candidates import Candidates, MotionPrior
from ekf_slam_node.filtering.models import Frame, frame_from_features, rig_points
from slam_core.geometry import FloatArray, invert_transform
from slam_experiments import thesis
from slam_experiments.experiments.filter_maps import map_figure, maps
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_simulation import Scenario
from slam_simulation.feature_level import FeatureFrame, FeatureSimulator

MODULE = "slam_experiments.experiments.association"


@dataclass(frozen=True)
class Variant:
    """A method, with or without descriptors, and with the motion predicted or not at all."""

    method: str
    descriptors: bool = True
    predicted: bool = True

    def config(self) -> FeatureAssociationConfig:
        """Configuration that the filter would get."""
        plain: dict[str, Any] = {} if self.descriptors else {"descriptor_threshold": -1.0, "descriptor_weight": 0.0}
        return replace(FeatureAssociationConfig(), method=self.method, **plain)


METHODS = {
    "Algorithm 1: nearest": Variant("nearest", descriptors=False),
    "Algorithm 1 + descriptors": Variant("nearest"),
    "Algorithm 2: Mahalanobis": Variant("mahalanobis", descriptors=False),
    "Algorithm 2 + descriptors": Variant("mahalanobis"),
    "JCBB, of 20 features": Variant("jcbb", descriptors=False),
    "JCBB, of 20 features + descriptors": Variant("jcbb"),
    "CCDA, of 20 features": Variant("ccda", descriptors=False),
    "CCDA, of 20 features + descriptors": Variant("ccda"),
    "Algorithm 2 + descriptors, motion unknown": Variant("mahalanobis", predicted=False),
    "CCDA, of 20 features + descriptors, motion unknown": Variant("ccda", predicted=False),
}
_JOINT = {"mahalanobis": associate_mahalanobis, "jcbb": associate_jcbb, "ccda": associate_ccda}
_RATES = (10, 5, 2)
_MAPS = {"nearest": ("4.5", "One filter with the shortest distance"),
         "mahalanobis": ("4.9", "One filter with Mahalanobis distance")}  # fmt: skip
"""Figure and caption of the map by an association."""
_SIGMA_MOTION = np.repeat([3.0, 4.0], 3)
"""Accelerations of the constant-velocity model, m/s2 and rad/s2."""
_UNKNOWN = MotionPrior(np.eye(4), np.diag(np.repeat([10.0, 3.0], 3) ** 2))


def associate(folder: Path, before: list[Path], method: str, every: int, frames: int) -> Kept:
    """Precision and recall of one method on a scenario's feature-level simulation, every n-th frame."""
    from filterpy.common import Q_discrete_white_noise  # a third of a second to import, and needed here alone

    variant = METHODS[method]
    simulator = FeatureSimulator(Scenario.load("workshop_handheld"))
    views = [simulator.frame(k * every) for k in range(frames)]
    dt = every / simulator.scenario.rate
    position_variance = Q_discrete_white_noise(2, dt)[0, 0]  # of an acceleration of 1 m/s2
    right = paired = common = 0
    for k in range(2, frames):
        first, second = views[k - 1], views[k]
        if variant.predicted:  # constant velocity
            step = invert_transform(views[k - 2].T_world_rig) @ first.T_world_rig
            prior = MotionPrior(step, np.diag(position_variance * _SIGMA_MOTION**2))
        else:
            prior = _UNKNOWN
        rows, columns = _pairs(first, second, prior, simulator.T_rig_left, variant.config())
        common += len(np.intersect1d(first.ids, second.ids))
        paired += len(rows)
        right += int((first.ids[rows] == second.ids[columns]).sum())
    return {"precision": right / max(paired, 1), "recall": right / max(common, 1)}, {}


def _pairs(
    first: FeatureFrame,
    second: FeatureFrame,
    prior: MotionPrior,
    T_rig_optical: FloatArray,
    config: FeatureAssociationConfig,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Candidates of the first frame and features of the second that the method pairs."""
    before, now = _frame(first), _frame(second)
    points, covariances = rig_points(before, T_rig_optical)
    candidates = Candidates(points, covariances, before.descriptors, np.zeros(len(points), dtype=np.int32))
    if config.method == "nearest":
        rows, columns = associate_nearest(candidates, now, prior.T, T_rig_optical, config)
        similarity = np.einsum("nd,nd->n", candidates.descriptors[rows], now.descriptors[columns])
        alike = similarity >= config.descriptor_threshold
        return rows[alike], columns[alike]
    associate = _JOINT[config.method]
    return associate(candidates, now, prior.T, prior.covariance, T_rig_optical, config)


def _frame(view: FeatureFrame) -> Frame:
    return frame_from_features(view.features, np.arange(len(view.features)), 0.01, 1e-5)


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        frames = 8 if quick else 60
        packages = (*RENDERING, "ekf_slam_node")
        return {
            f"{method}, {rate} Hz": Job(
                f"{MODULE}:associate", {"method": method, "every": 10 // rate, "frames": frames}, packages
            )
            for method in METHODS
            for rate in _RATES
        } | maps(tuple(_MAPS), 20 if quick else 330)

    def report(results: Mapping[str, JobResult]) -> Findings:
        rows = [
            [
                method,
                *(
                    f"{results[f'{method}, {rate} Hz'].values[key]:.3f}"
                    for rate in _RATES
                    for key in ("precision", "recall")
                ),
            ]
            for method in METHODS
        ]
        f = {
            name: 2 * v["precision"] * v["recall"] / max(v["precision"] + v["recall"], 1e-9)
            for name, v in ((name, r.values) for name, r in results.items() if not name.startswith("map, "))
        }
        nearest, mahalanobis = f["Algorithm 1: nearest, 10 Hz"], f["Algorithm 2: Mahalanobis, 10 Hz"]
        header = ("method", *(f"{key}, {rate} Hz" for rate in _RATES for key in ("precision", "recall")))
        return Findings(
            [Comparison("pairs of frames, not loops: harmonic mean of precision and recall, nearest and Mahalanobis",
                        thesis.MAHALANOBIS, f"{nearest:.3f}, {mahalanobis:.3f}",
                        "Mahalanobis higher", mahalanobis > nearest)],
            [Table("Frame to frame, against the true association", header, rows)],
            [
                Picture(map_figure(run.arrays), number, f"{caption}: {len(run.arrays['landmarks'])} landmarks, RMSE of "
                        f"the path {1e3 * run.values['rmse_m']:.1f} mm.")
                for method, (number, caption) in _MAPS.items()
                for run in (results[f"map, {method}"],)
            ],
        )  # fmt: skip

    return Experiment("association", "4.2-4.5", "Nearest neighbour against Mahalanobis distance", jobs, report)


EXPERIMENTS = (_experiment(),)
