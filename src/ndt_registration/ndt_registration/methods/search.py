# SPDX-License-Identifier: Apache-2.0
"""Global search for a pose.

Rotations from the normals, translations from a lattice, then NDT in rounds that keep ever fewer poses.

What makes a pose good is the same throughout: the scans' points must not lie in space that the other has looked
through, and must lie on its surfaces. Free space alone is blind where little is shared, and fit alone pulls a scan over
its neighbour; the cost of a pose is the conflict less a share of the score.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ndt_registration.clouds.cloud import Cloud
from ndt_registration.clouds.near_field import lattice_costs, near_field
from ndt_registration.clouds.orientation import ball_lattice, best_rotations, facing_normals, rotation_lattice
from ndt_registration.clouds.visibility import Prices, RangeImage, visibility_cost
from ndt_registration.methods.ndt import NdtOptimum, ndt_align
from ndt_registration.methods.pyramid import Pyramid
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform

_ROTATIONS = 4
"""Rotations that are combined with every translation."""
_TOLERANCE = 0.03
"""Deviation along the ray that costs nothing in the lattice, over the scale."""
_LATTICE_POINTS = 40
"""Points judged at each pose of the lattice."""
_SHORTLIST = 200
"""Poses of the lattice that are looked at with more points."""
_STARTS = 16
"""Poses of the lattice that are refined."""
_JUDGE_POINTS = 500
"""Points used to judge refined poses."""
_JUDGE_TOLERANCE = 0.02
"""Deviation along the ray that costs nothing there, over the scale."""
_SCORE_GAIN = 0.3
"""Amount that a full score takes off the cost of a pose."""


@dataclass(frozen=True)
class SearchConfig(Config):
    """Reach and resolution of the global search; lengths are relative to the cloud's scale (its median range)."""

    enabled: bool = parameter(True, "search globally where no initial guess is given")
    max_rotation_deg: float = 37.0
    """Largest rotation looked for, deg."""
    rotation_step_deg: float = 7.0
    """Spacing of the rotations, deg."""
    max_translation: float = 0.6
    """Largest translation looked for, over the scale."""
    translation_step: float = 0.07
    """Spacing of the translations, over the scale."""


PRICES = Prices(unseen=0.15, hidden=0.5, free=2.0)
"""Nothing is lost where a scan ends, little where things hide each other, but space that was seen free stays free."""
SEPARATION = 0.05
"""Poses nearer than this (rad, and translation over the scale) are the same candidate."""
_SLIGHT_LOSS = 0.1
"""Share of the score: poses are the same if the way between them is expected to cost no more."""
_START_SEPARATION = 0.1
"""Like it, between starts of the same rotation."""
_PATCH = 1 / 16
"""Edge of the patches that have normals, over the scale."""
_FIELD_EDGE = 0.05
_FIELD_REACH = 2.0
"""Voxels and half-edge of the map of nearness, over the scale."""
_FIELD_POINTS = 8000


class Round(NamedTuple):
    """One round of refinement: level of the pyramid, points used, most iterations, most poses that stay."""

    level: int
    points: int
    iterations: int
    keep: int


ROUNDS = (Round(2, 300, 8, 6), Round(1, 1000, 10, 4))


class Candidate(NamedTuple):
    """A pose T_target_source, its cost (lower is better), and what that is made of: visibility conflict and score.

    curvature (6, 6): by how much per point the score bends down around the pose.
    """

    T: FloatArray
    cost: float
    conflict: float
    score: float
    curvature: FloatArray


class Views(NamedTuple):
    """Two scans with what each has seen."""

    source: Cloud
    source_image: RangeImage
    target: Cloud
    target_image: RangeImage

    @property
    def scale(self) -> float:
        """Median range of the target, m."""
        return max(self.target.scale, 1e-6)


def search(views: Views, pyramid: Pyramid, rim_share: float, config: SearchConfig) -> list[Candidate]:
    """Distinct refined poses, best first."""
    poses = _starts(views, config)
    fixed = planar_constraint(views.source.planar)
    for step in ROUNDS:
        layers = pyramid.layers(views.source, step.level, step.points, rim_share)
        refined = []
        for T in poses:
            R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
            optimum = ndt_align(layers, R, t, fixed, views.scale, step.iterations, 1e-3 * views.scale)
            refined.append(judge(views, optimum))
        candidates = distinct(sorted(refined, key=lambda candidate: candidate.cost), views.scale, step.keep)
        poses = [candidate.T for candidate in candidates]
    return candidates


def distinct(candidates: list[Candidate], scale: float, count: int) -> list[Candidate]:
    """The first ``count`` candidates that are not the same as one before them."""
    kept: list[Candidate] = []
    for candidate in candidates:
        if not any(is_same(other, candidate, scale) for other in kept):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def is_same(candidate: Candidate, other: Candidate, scale: float) -> bool:
    """True if two poses are one answer: near each other, or apart only where the scan leaves the pose free."""
    if pose_distance(candidate.T, other.T, scale) < SEPARATION:
        return True
    d = boxminus(other.T, candidate.T)
    return bool(0.5 * d @ candidate.curvature @ d < _SLIGHT_LOSS * candidate.score)


def pose_distance(T: FloatArray, other: FloatArray, scale: float) -> float:
    """Rotation angle (rad) plus translation over the scale between two poses."""
    # The chord of the rotation: exact also where the angle is small, which the trace is not.
    chord = np.linalg.norm(T[:3, :3] - other[:3, :3]) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(chord, 1.0)) + np.linalg.norm(T[:3, 3] - other[:3, 3]) / scale)


def judge(views: Views, optimum: NdtOptimum) -> Candidate:
    """An optimum with its cost; each scan's points are held against what the other has seen."""
    T, score = make_transform(optimum.rotation, optimum.translation), optimum.score
    tolerance = _JUDGE_TOLERANCE * views.scale
    conflict = 0.0
    for points, image, pose in (
        (views.source.sample(_JUDGE_POINTS), views.target_image, T),
        (views.target.sample(_JUDGE_POINTS), views.source_image, invert_transform(T)),
    ):
        conflict += 0.5 * visibility_cost(points, pose, image, tolerance, PRICES)
    curvature = optimum.majorant / max(optimum.points, 1)
    return Candidate(T, conflict - _SCORE_GAIN * score, conflict, score, curvature)


def _starts(views: Views, config: SearchConfig) -> list[FloatArray]:
    """The most promising poses of the lattice, and the sensor at rest."""
    source, target, scale = views.source, views.target, views.scale
    largest, step = np.deg2rad(config.max_rotation_deg), np.deg2rad(config.rotation_step_deg)
    if source.planar:
        rotations = rotation_lattice(largest, step, (2,))
    else:
        a, b = (facing_normals(cloud.points, _PATCH * scale) for cloud in (source, target))
        rotations = best_rotations(a, b, largest, step, _ROTATIONS)
    axes = (0, 1) if source.planar else (0, 1, 2)
    translations = scale * ball_lattice(config.max_translation, config.translation_step, axes)
    field = near_field(target.sample(_FIELD_POINTS), _FIELD_EDGE * scale, _FIELD_REACH * scale)
    seen = (views.target_image, _TOLERANCE * scale, PRICES, field, _SCORE_GAIN)
    costs = lattice_costs(source.sample(_LATTICE_POINTS), rotations, translations, *seen).ravel()
    shortlist = np.argsort(costs, kind="stable")[:_SHORTLIST]
    turns, shifts = np.divmod(shortlist, len(translations))
    points = source.sample(_JUDGE_POINTS)
    again = np.empty(len(shortlist))
    for turn in np.unique(turns):
        of_turn = turns == turn
        again[of_turn] = lattice_costs(points, rotations[turn, None], translations[shifts[of_turn]], *seen)[0]
    chosen: list[int] = []
    for k in np.argsort(again, kind="stable"):
        same = [j for j in chosen if turns[j] == turns[k]]
        gaps = np.linalg.norm(translations[shifts[same]] - translations[shifts[k]], axis=1)
        if (gaps > _START_SEPARATION * scale).all():
            chosen.append(int(k))
        if len(chosen) == _STARTS:
            break
    return [np.eye(4), *(make_transform(rotations[turns[k]], translations[shifts[k]]) for k in chosen)]


def planar_constraint(planar: bool) -> FloatArray:
    """Mask (6,) of the components of a pose error that are held: z, roll and pitch in the plane, none in space."""
    return np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]) if planar else np.zeros(6)
