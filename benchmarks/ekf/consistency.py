"""Are the covariances true? Monte-Carlo over simulated features: NEES of poses, landmarks and whole submaps, NIS.

    python benchmarks/ekf/consistency.py [RUNS]

Every figure is per degree of freedom and should be one; the interval is where the mean of that many independent runs
lies in 95 % of the cases. "seam" is the disagreement of consecutive submaps about the landmarks they share: below one,
the two share information that joining would count twice.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.progress import track

from ekf_slam_node.config import EkfSlamConfig
from slam_core.config import from_mapping
from slam_core.evaluation import anees_bounds
from slam_core.geometry import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test" / "ekf_slam_node"))
from feature_world import loop, wander
from monte_carlo import Run, seam_nees, simulate
from planar_monte_carlo import planar_nees

WALK_SIGMA = np.repeat([0.5, 0.4], 3)
WALK_START = np.repeat([0.3, 0.2], 3)
WALK = {
    "motion.sigma_acceleration": 0.5, "motion.sigma_angular_acceleration": 0.4,
    "motion.sigma_initial_velocity": 0.3, "motion.sigma_initial_turn_rate": 0.2,
}  # fmt: skip
ENDLESS = {"submap.max_distance": 1e6, "submap.max_landmarks": 10**6, "submap.max_frames": 10**6}
SPARSE = {"landmark.target_in_view": 25}


def walk(rng: np.random.Generator) -> list[FloatArray]:
    return wander(30, 0.1, WALK_SIGMA, WALK_START, rng, 0.8)


def rig(rng: np.random.Generator) -> list[FloatArray]:
    return loop(40, 10.0, 1.5, 0.4)


def handheld(rng: np.random.Generator) -> list[FloatArray]:
    return loop(40, 10.0, 1.5, 0.4, handheld=0.02)


def long_tour(rng: np.random.Generator) -> list[FloatArray]:
    return loop(150, 10.0, 1.5, 2.0, handheld=0.02)


CASES: dict[str, tuple[Callable[[np.random.Generator], list[FloatArray]], dict[str, object]]] = {
    "3D, the filter's own motion": (walk, WALK | ENDLESS),
    "rig, independent start": (rig, {}),
    "handheld, independent start": (handheld, {}),
    "handheld, conditional start": (handheld, {"submap.start": "conditional"}),
    "handheld, standard error": (handheld, {"error": "standard"}),
    "two rounds, one EKF, invariant": (long_tour, ENDLESS | SPARSE),
    "two rounds, one EKF, standard": (long_tour, ENDLESS | SPARSE | {"error": "standard"}),
}


def line(name: str, runs: list[Run]) -> str:
    submaps = [s for run in runs for s in run.submaps]
    seams = [
        seam_nees(a.submap, b.submap) for run in runs for a, b in pairwise(run.submaps) if b.submap.follows_previous
    ]
    low, high = anees_bounds(6, len(runs))
    first = np.mean([run.submaps[0].pose_nees for run in runs]) / 6
    cells = (
        f"{first:6.3f} [{low:.2f} {high:.2f}]", _mean([s.landmark_nees / 3 for s in submaps]),
        _mean([s.joint_nees for s in submaps]), _mean(seams), _mean([run.nis for run in runs]),
    )  # fmt: skip
    return f"{name:32}" + "".join(f"{cell:>20}" for cell in cells)


def _mean(values: list[float]) -> str:
    """Mean and the half width of its 95 % interval, from the spread of the runs."""
    return f"{np.mean(values):.3f} +-{1.96 * np.std(values) / np.sqrt(len(values)):.3f}" if values else "-"


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    print(f"{runs} runs\n{'':32}{'first pose':>20}{'landmarks':>20}{'joint':>20}{'seam':>20}{'NIS':>20}")
    for name, (make_poses, overrides) in CASES.items():
        config = from_mapping(EkfSlamConfig, overrides)
        done = [simulate(1000 + seed, config, make_poses) for seed in track(range(runs), name, transient=True)]
        print(line(name, done), flush=True)
    for rough, course in ((False, "2D, one round"), (True, "2D, four rough rounds, one EKF")):
        for error in ("invariant", "standard"):
            pose, landmarks, nis = planar_nees(runs, error, rough)
            low, high = anees_bounds(3, runs)
            name = f"{course}, {error}"
            print(f"{name:42}{pose:7.3f} [{low:.2f} {high:.2f}]{landmarks:14.3f}{'':40}{nis:20.3f}", flush=True)


if __name__ == "__main__":
    main()
