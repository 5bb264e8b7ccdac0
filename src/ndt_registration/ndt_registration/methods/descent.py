# SPDX-License-Identifier: Apache-2.0
"""Descent of the NDT cost from coarse to fine, from one pose or from each that a search leaves in question."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ndt_registration.clouds.cloud import Cloud
from ndt_registration.methods.ndt import NdtOptimum, ndt_align
from ndt_registration.methods.pyramid import Pyramid
from ndt_registration.methods.search import Candidate, SearchConfig, Views, judge, planar_constraint, search
from slam_core.geometry import FloatArray, make_transform, quaternion_from_rotation, rotation_from_quaternion

COARSE_POINTS = 2000
"""Most points of the source on all but the finest level, and with all but ICP's last limit."""
_MAX_ITERATIONS = 50
"""Most iterations per level."""
_TOLERANCE = 1e-4
"""Length of the last step, over the scale."""
_COARSE_TOLERANCE = 10.0
"""So many times the tolerance ends a coarser level: its optimum only starts the next one."""
_SEARCHED_LEVEL = 1
"""Coarsest level used from a pose of the search."""
_IN_QUESTION = 0.06
"""Cost by which the best pose of a search must beat another one before both are refined."""


class Answer(NamedTuple):
    """A minimum of the NDT cost on the finest level, judged, and the iterations to it."""

    candidate: Candidate
    optimum: NdtOptimum
    iterations: int


def descend(
    source: Cloud, pyramid: Pyramid, T: FloatArray, start: int, scale: float, rim_share: float
) -> tuple[NdtOptimum, int]:
    """NDT from level ``start`` down to the finest; the optimum there and the iterations in all."""
    iterations = 0
    fixed = planar_constraint(source.planar)
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    for level in range(min(start, len(pyramid.grids) - 1), -1, -1):
        count = len(source) if level == 0 else COARSE_POINTS
        layers = pyramid.layers(source, level, count, rim_share)
        tolerance = _TOLERANCE * scale * (1.0 if level == 0 else _COARSE_TOLERANCE)
        optimum = ndt_align(layers, R, t, fixed, scale, _MAX_ITERATIONS, tolerance)
        R, t = optimum.rotation, optimum.translation
        iterations += optimum.iterations
    return optimum, iterations


def searched_minima(views: Views, pyramid: Pyramid, rim_share: float, config: SearchConfig) -> list[Answer]:
    """Minima on the finest level below the search's best pose and all that cost hardly more, best first.

    The search ends on a coarser level after few iterations: poses that it still tells apart are mostly on their way to
    one and the same minimum, and which of two minima is the better one shows on the finest level only.
    """
    candidates = search(views, pyramid, rim_share, config)
    answers = []
    for candidate in candidates:
        if candidate.cost < candidates[0].cost + _IN_QUESTION:
            found = descend(views.source, pyramid, candidate.T, _SEARCHED_LEVEL, views.scale, rim_share)
            answers.append(Answer(judge(views, found[0]), *found))
    return sorted(answers, key=lambda answer: answer.candidate.cost)


def orthonormal_pose(optimum: NdtOptimum) -> FloatArray:
    """The optimum's pose, its rotation exactly orthonormal again."""
    return make_transform(rotation_from_quaternion(quaternion_from_rotation(optimum.rotation)), optimum.translation)
