"""Precision and recall of the association against the simulated truth, at several frame rates, with and without
descriptors.

    python benchmarks/ekf/association.py

A pair is right if the landmark and the feature are the same point of the world. Recall is the share of the features
whose point was in view of the last frame too that were paired. The step to be bridged is predicted by the last
velocity.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from ekf_slam_node.candidates import Candidates, MotionPrior, motion_prior
from ekf_slam_node.config import AssociationConfig
from ekf_slam_node.linking import Linker
from ekf_slam_node.models import Frame, frame_from_features, rig_points, velocity_of_motion
from slam_core.geometry import FloatArray, invert_transform

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test" / "ekf_slam_node"))
from feature_world import T_RIG_OPTICAL, PointWorld, loop, room

SIGMA = np.repeat([3.0, 4.0], 3)
METHODS = {
    "nearest (Algorithm 1)": {"method": "nearest", "descriptor_threshold": -1.0},
    "Mahalanobis, no descriptors": {"descriptor_threshold": -1.0, "descriptor_weight": 0.0},
    "Mahalanobis (Algorithm 2)": {"descriptor_weight": 0.0},
    "Mahalanobis + descriptor weight": {},
    "JCBB": {"method": "jcbb"},
}


def see(world: PointWorld, T: FloatArray, stamp_ns: int, rng: np.random.Generator) -> tuple[Frame, np.ndarray]:
    features, index = world.features(T, stamp_ns, rng, max_features=200)
    return frame_from_features(features, np.arange(len(features)), 0.01, 1e-5), index


def predicted(poses: list[FloatArray], k: int, dt: float) -> MotionPrior:
    """Constant velocity from the step before."""
    velocity = velocity_of_motion(invert_transform(poses[k - 2]) @ poses[k - 1], dt)
    return motion_prior(velocity, 1e-3 * np.eye(6), SIGMA, dt)


def score(config: AssociationConfig, rate: float) -> tuple[float, float, float, float]:
    """Precision, recall, share of frames linked, median milliseconds."""
    rng = np.random.default_rng(0)
    world, poses = room(rng, 1500), loop(int(8 * rate), rate, turns=0.8, handheld=0.02)
    linker = Linker(config, T_RIG_OPTICAL)
    views = [see(world, T, k + 1, rng) for k, T in enumerate(poses)]
    right = paired = common = linked = 0
    times = []
    for k in range(2, len(poses)):
        (before, first), (now, second) = views[k - 1], views[k]
        candidates = Candidates(*rig_points(before, T_RIG_OPTICAL), before.descriptors)
        start = time.perf_counter()
        link = linker.link(candidates, now, predicted(poses, k, 1.0 / rate))
        times.append(time.perf_counter() - start)
        common += len(np.intersect1d(first, second))
        if link is not None:
            linked += 1
            paired += len(link.rows)
            right += int((first[link.rows] == second[link.columns]).sum())
    return right / max(paired, 1), right / common, linked / (len(poses) - 2), 1e3 * float(np.median(times))


def main() -> None:
    print(f"{'method':34}{'FPS':>5}{'precision':>11}{'recall':>9}{'linked':>9}{'ms':>8}")
    for name, overrides in METHODS.items():
        for rate in (10.0, 5.0, 2.0):
            precision, recall, linked, took = score(AssociationConfig(**overrides), rate)  # type: ignore[arg-type]
            print(f"{name:34}{rate:5.0f}{precision:11.4f}{recall:9.3f}{linked:9.2f}{took:8.1f}", flush=True)


if __name__ == "__main__":
    main()
