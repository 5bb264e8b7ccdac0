# SPDX-License-Identifier: Apache-2.0
"""Are the covariances true? Monte-Carlo over simulated features: NEES of poses, landmarks and whole submaps, NIS.

    python benchmarks/ekf/consistency.py [RUNS [PART OF A CASE'S NAME]]

Every figure is per degree of freedom and should be one; the interval is where the mean of that many independent runs
lies in 95 % of the cases. "seam" is the disagreement of consecutive submaps about the landmarks they share: below one,
the two share information that joining would count twice. NIS: the interval is that of a gated chi-square, widened for
rigs that move more smoothly than their model says. "end": of the last pose against the first, and what the run says of
its heading (root mean square of the standard deviations) beside how wrong it is. ms: processor time of the estimator
in one of the last ten frames.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.progress import track

from ekf_slam_node.config import EkfSlamConfig, FeatureAssociationConfig
from slam_core.config import from_mapping
from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test" / "ekf_slam_node"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test" / "slam_experiments"))
from monte_carlo import Run, mean_nis, seam_nees, simulate
from planar_monte_carlo import planar_nees

from feature_world import PointWorld, loop, room, tour_of_two_rooms, two_rooms, wander

WALK_SIGMA = np.repeat([0.5, 0.4], 3)
WALK_START = np.repeat([0.3, 0.2], 3)
WALK: dict[str, object] = {
    "motion.sigma_acceleration": 0.5,
    "motion.sigma_angular_acceleration": 0.4,
    "motion.sigma_initial_velocity": 0.3,
    "motion.sigma_initial_turn_rate": 0.2,
}
ENDLESS: dict[str, object] = {"submap.max_distance": 1e6, "submap.max_landmarks": 10**6, "submap.max_frames": 10**6}
SPARSE: dict[str, object] = {"landmark.target_in_view": 25}


def walk(rng: np.random.Generator) -> list[FloatArray]:
    return wander(30, 0.1, WALK_SIGMA, WALK_START, rng, 0.8)


def rig(rng: np.random.Generator) -> list[FloatArray]:
    return loop(40, 10.0, 1.5, 0.4)


def handheld(rng: np.random.Generator) -> list[FloatArray]:
    return loop(40, 10.0, 1.5, 0.4, handheld=0.02)


def long_tour(rng: np.random.Generator) -> list[FloatArray]:
    return loop(150, 10.0, 1.5, 2.0, handheld=0.02)


def tour(rng: np.random.Generator) -> list[FloatArray]:
    return tour_of_two_rooms()


@dataclass(frozen=True)
class Case:
    """A course, what it changes of the configuration, and the world."""

    make_poses: Callable[[np.random.Generator], list[FloatArray]]
    overrides: dict[str, object]
    make_world: Callable[[np.random.Generator], PointWorld] = room


CASES = {
    "3D, the filter's own motion": Case(walk, WALK | ENDLESS),
    "rig, independent start": Case(rig, {}),
    "handheld, independent start": Case(handheld, {}),
    "handheld, conditional start": Case(handheld, {"submap.start": "conditional"}),
    "handheld, standard error": Case(handheld, {"error": "standard"}),
    "two rounds, one EKF, invariant": Case(long_tour, ENDLESS | SPARSE),
    "two rounds, one EKF, standard": Case(long_tour, ENDLESS | SPARSE | {"error": "standard"}),
    "two rooms, submaps": Case(tour, SPARSE, two_rooms),
    "two rooms, one EKF, invariant": Case(tour, ENDLESS | SPARSE, two_rooms),
    "two rooms, one EKF, standard": Case(tour, ENDLESS | SPARSE | {"error": "standard"}, two_rooms),
}


def line(name: str, case: Case, runs: list[Run]) -> str:
    submaps = [s for run in runs for s in run.submaps]
    seams = [
        seam_nees(a.submap, b.submap)
        for run in runs
        for a, b in pairwise(run.submaps)
        if b.submap.follows_previous and np.isin(a.submap.landmark_ids, b.submap.landmark_ids).any()
    ]
    bounds = "[{:.2f} {:.2f}]".format(*anees_bounds(6, len(runs)))
    first = np.mean([run.submaps[0].pose_nees for run in runs]) / 6
    end = np.mean([nees(run.end_error, run.end_covariance) for run in runs]) / 6
    nis, low, high = mean_nis(runs, FeatureAssociationConfig().gate, case.make_poses is walk)
    claimed, wrong = ([value(r) for r in runs] for value in (_heading_variance, _squared_heading_error))
    cells = (
        f"{first:6.3f} {bounds}",
        _mean([s.landmark_nees / 3 for s in submaps]),
        _mean([s.joint_nees for s in submaps]),
        _mean(seams),
        f"{nis:.3f} [{low:.3f} {high:.3f}]",
        f"{end:6.3f} {bounds}",
        f"{_rms_degrees(claimed):.2f}, wrong {_rms_degrees(wrong):.2f}",
        f"{np.median([run.ms[-10:] for run in runs]):.1f}",
    )
    return f"{name:32}" + "".join(f"{cell:>21}" for cell in cells)


def _heading_variance(run: Run) -> float:
    return float(run.end_covariance[5, 5])


def _squared_heading_error(run: Run) -> float:
    return float(run.end_error[5] ** 2)


def _rms_degrees(squares: list[float]) -> float:
    return float(np.degrees(np.sqrt(np.mean(squares))))


def _mean(values: list[float]) -> str:
    """Mean and the half width of its 95 % interval, from the spread of the runs."""
    return f"{np.mean(values):.3f} +-{1.96 * np.std(values) / np.sqrt(len(values)):.3f}" if values else "-"


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    wanted = sys.argv[2] if len(sys.argv) > 2 else ""
    headings = ("first pose", "landmarks", "joint", "seam", "NIS", "end pose", "end heading, deg", "ms")
    print(f"{runs} runs\n{'':32}" + "".join(f"{heading:>21}" for heading in headings))
    for name, case in CASES.items():
        if wanted in name:
            config = from_mapping(EkfSlamConfig, case.overrides)
            seeds = track(range(1000, 1000 + runs), name, transient=True)
            done = [simulate(seed, config, case.make_poses, case.make_world) for seed in seeds]
            print(line(name, case, done), flush=True)
    if wanted in "2D":
        print_planar(runs)


def print_planar(runs: int) -> None:
    for rough, course in ((False, "2D, one round"), (True, "2D, four rough rounds, one EKF")):
        for error in ("invariant", "standard"):
            pose, landmarks, nis = planar_nees(runs, error, rough)
            low, high = anees_bounds(3, runs)
            name = f"{course}, {error}"
            print(f"{name:42}{pose:7.3f} [{low:.2f} {high:.2f}]{landmarks:14.3f}{'':40}{nis:20.3f}", flush=True)


if __name__ == "__main__":
    main()
