"""Global search for a pose: a coarse lattice of motions judged by free space, each promising one refined on coarse
cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ndt_registration.cloud import Cloud
from ndt_registration.ndt import ndt_align
from ndt_registration.pyramid import Pyramid
from ndt_registration.visibility import Prices, RangeImage, lattice_costs, visibility_cost
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, make_transform, so3_exp, so3_log


@dataclass(frozen=True)
class SearchConfig(Config):
    """Reach and resolution of the global search; lengths are relative to the cloud's scale (its median range)."""

    enabled: bool = parameter(True, "search globally where no initial guess is given")
    max_rotation_deg: float = parameter(37.0, "largest rotation looked for", unit="deg", minimum=0.0, maximum=180.0)
    rotation_step_deg: float = parameter(18.0, "spacing of the rotations", unit="deg", minimum=1.0)
    max_translation: float = parameter(0.6, "largest translation looked for, over the scale", minimum=0.0)
    translation_step: float = parameter(0.2, "spacing of the translations, over the scale", minimum=0.01)
    tolerance: float = parameter(
        0.08, "deviation along the ray that costs nothing in the lattice, over the scale", minimum=0.001
    )
    lattice_points: int = parameter(64, "points judged at each pose of the lattice", minimum=8)
    starts: int = parameter(40, "poses of the lattice that are refined", minimum=1)
    refine_points: int = parameter(200, "points used in the refinement", minimum=16)
    refine_iterations: int = parameter(10, "most iterations per level of the refinement", minimum=1)
    rim_share: float = parameter(0.2, "weight of all rims over that of all surfaces", minimum=0.0)
    judge_points: int = parameter(500, "points used to judge refined poses", minimum=16)
    judge_tolerance: float = parameter(
        0.02, "deviation along the ray that costs nothing there, over the scale", minimum=0.001
    )
    candidates: int = parameter(4, "distinct refined poses that are handed on", minimum=1)


PRICES = Prices(unseen=0.15, hidden=0.5, free=2.0)
"""Nothing is lost where a scan ends, little where things hide each other, but space that was seen free stays free."""
REFINEMENT_LEVELS = (3, 2)
SEPARATION = 0.05
"""Poses nearer than this (rad, and translation over the scale) are the same candidate."""


class Candidate(NamedTuple):
    """A pose T_target_source and its visibility cost, lower is better."""

    T: FloatArray
    cost: float


@lru_cache(maxsize=8)
def _lattice(radius: float, step: float, axes: tuple[int, ...]) -> FloatArray:
    """Points of a cubic lattice inside a ball, shape (k, 3); only the given axes are used."""
    reach = int(np.floor(radius / step + 1e-9))
    line = np.arange(-reach, reach + 1) * step
    grids = np.meshgrid(*[line if axis in axes else np.zeros(1) for axis in range(3)], indexing="ij")
    points = np.stack(grids, axis=-1).reshape(-1, 3)
    return np.asarray(points[np.linalg.norm(points, axis=1) <= radius * (1.0 + 1e-9)])


def search(source: Cloud, pyramid: Pyramid, image: RangeImage, scale: float, config: SearchConfig) -> list[Candidate]:
    """Distinct promising poses, best first."""
    starts = _best_of_lattice(source, image, scale, config)
    refined = [_refine(source, pyramid, image, scale, T, config) for T in starts]
    return distinct(sorted(refined, key=lambda candidate: candidate.cost), SEPARATION, scale, config.candidates)


def distinct(candidates: list[Candidate], separation: float, scale: float, count: int) -> list[Candidate]:
    """The first ``count`` candidates that differ by more than ``separation`` (rad, and translation over the scale)."""
    kept: list[Candidate] = []
    for candidate in candidates:
        if all(pose_distance(candidate.T, other.T, scale) > separation for other in kept):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def pose_distance(T: FloatArray, other: FloatArray, scale: float) -> float:
    """Rotation angle (rad) plus translation over the scale between two poses."""
    angle = np.linalg.norm(so3_log(T[:3, :3] @ other[:3, :3].T))
    return float(angle + np.linalg.norm(T[:3, 3] - other[:3, 3]) / scale)


def judge(source: Cloud, image: RangeImage, scale: float, T: FloatArray, config: SearchConfig) -> float:
    """Visibility cost of the source at a pose."""
    turned = np.ascontiguousarray(source.sample(config.judge_points) @ T[:3, :3].T)
    return float(visibility_cost(turned, T[:3, 3].copy(), image, config.judge_tolerance * scale, PRICES))


def _best_of_lattice(source: Cloud, image: RangeImage, scale: float, config: SearchConfig) -> list[FloatArray]:
    rotation_axes, translation_axes = ((2,), (0, 1)) if source.planar else ((0, 1, 2), (0, 1, 2))
    vectors = _lattice(np.deg2rad(config.max_rotation_deg), np.deg2rad(config.rotation_step_deg), rotation_axes)
    translations = scale * _lattice(config.max_translation, config.translation_step, translation_axes)
    rotations = so3_exp(vectors)
    points = source.sample(config.lattice_points)
    costs = lattice_costs(points, rotations, translations, image, config.tolerance * scale, PRICES).ravel()
    best = np.argsort(costs, kind="stable")[: config.starts]
    chosen = [make_transform(rotations[k // len(translations)], translations[k % len(translations)]) for k in best]
    return [np.eye(4), *chosen]


def _refine(
    source: Cloud, pyramid: Pyramid, image: RangeImage, scale: float, T: FloatArray, config: SearchConfig
) -> Candidate:
    fixed = planar_constraint(source.planar)
    for level in REFINEMENT_LEVELS:
        layers = pyramid.layers(source, level, config.refine_points, config.rim_share)
        optimum = ndt_align(
            layers, np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), fixed, scale,
            config.refine_iterations, 1e-3 * scale,
        )  # fmt: skip
        T = make_transform(optimum.rotation, optimum.translation)
    return Candidate(T, judge(source, image, scale, T, config))


def planar_constraint(planar: bool) -> FloatArray:
    """Which components of a pose error are held, shape (6,): z, roll and pitch in the plane, none in space."""
    return np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]) if planar else np.zeros(6)
