# SPDX-License-Identifier: Apache-2.0
"""Registration of one cloud to another.

``register(source, target) -> RegistrationResult``, one setting for every motion.

Without an initial guess the pose is searched globally (:mod:`ndt_registration.methods.search`), each promising pose is
refined by NDT from coarse to fine, and the one that respects best what the target has seen, surfaces and free space,
wins.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ndt_registration.clouds.cloud import Cloud, finite_points, is_planar, largest_extent, prepare, viewpoint
from ndt_registration.clouds.visibility import RangeImage, range_image
from ndt_registration.methods.ambiguity import ambiguity_reason, spread_of_neighbours
from ndt_registration.methods.descent import COARSE_POINTS, Answer, descend, orthonormal_pose, searched_minima
from ndt_registration.methods.icp import IcpConfig, IcpTarget, icp_align
from ndt_registration.methods.matching import block_gradients, fit_to_grid
from ndt_registration.methods.ndt import Layer, NdtOptimum, ndt_align
from ndt_registration.methods.pyramid import GridConfig, Pyramid
from ndt_registration.methods.score_loss import ScoreLoss
from ndt_registration.methods.search import Candidate, SearchConfig, Views, judge, planar_constraint
from ndt_registration.methods.uncertainty import (
    Curvature,
    Extent,
    UncertaintyConfig,
    clear_loss,
    direction_names,
    gradient_scatter,
    sandwich,
    unknown,
)
from slam_core.config import Config, group, parameter
from slam_core.geometry import (
    FloatArray,
    is_rigid_transform,
    make_transform,
    skew,
)

IMAGE_SIZE = 64
"""Edge of the range image that holds free space, px."""
_MIN_OVERLAP = 0.15
"""Least share of source points on the target's surfaces."""
_MAX_CONFLICT = 0.3
"""Largest visibility cost of a success."""

_LEAST_EXTENT, _LARGEST_EXTENT = 1e-6, 1e15
"""Extent of a cloud, m, between which sums and squares of its coordinates mean something."""
_PLANAR_VOXEL_SIZE = 0.18
"""Edge of the finest cells of a scan in the plane, over its scale."""
_PLANAR_CELL_POINTS, _PLANAR_SCAN_POINTS = 4, 30
"""Fewest points of a cell, and finite ones of a scan, in the plane."""
_ROUNDING = 4e-15
"""Variance of rounding over the trace of a covariance (6, 6): what keeps it positive definite at a long lever."""


@dataclass(frozen=True)
class RegistrationConfig(Config):
    """One setting for all: everything of length is relative to the cloud's scale unless it is set."""

    method: str = parameter("ndt", "registration method", choices=("ndt", "icp", "icp_plane"))
    target_points: int = parameter(20000, "most points of the target that are used", minimum=10)
    source_points: int = parameter(8000, "most points of the source that are used", minimum=10)
    min_points: int = 50
    """Fewest finite points of a cloud."""
    start_level: int = 2
    """Coarsest level used from a given initial guess."""
    rim_share: float = 0.1
    """Weight of all rims over that of all surfaces."""
    icp: IcpConfig = group(IcpConfig)
    grid: GridConfig = group(GridConfig)
    search: SearchConfig = group(SearchConfig)
    uncertainty: UncertaintyConfig = group(UncertaintyConfig)


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """Outcome of a registration; ``T_target_source`` must only be used where ``converged``.

    covariance: (6, 6) of the pose error of ``slam_core.geometry``, very large along ``degenerate`` directions, which
    are named. score: mean over the points that overlap of how well they fit, 0 to 1. overlap: share of the source's
    points that lie on surfaces of the target. inlier_rmse: their distance from those surfaces, m. reason: why it failed
    or what to mind; empty for a plain success.
    """

    T_target_source: FloatArray
    covariance: FloatArray
    converged: bool
    iterations: int
    score: float
    overlap: float
    inlier_rmse: float
    reason: str
    degenerate: tuple[str, ...] = field(default=())


@dataclass(frozen=True, eq=False)
class Target:
    """A cloud that others are registered to, with everything that can be computed beforehand.

    ``centre`` is its origin.
    """

    cloud: Cloud
    pyramid: Pyramid
    image: RangeImage
    centre: FloatArray
    _icp: list[IcpTarget] = field(default_factory=list)

    def icp(self) -> IcpTarget:
        """The cloud with kd-tree and normals, made when first asked for."""
        if not self._icp:
            self._icp.append(IcpTarget(self.cloud.points))
        return self._icp[0]

    @staticmethod
    def build(points: npt.ArrayLike, config: RegistrationConfig) -> Target:
        """Prepare a cloud (..., 3) or (..., 2).

        Raises
        ------
        ValueError
            If fewer than ``config.min_points`` points are finite, or all of them coincide.
        """
        finite = finite_points(points)
        config = for_dimension(config, planar=is_planar(points))
        check_cloud(finite, "target", config)
        centre = viewpoint(finite)
        cloud = prepare(finite, config.target_points, planar=is_planar(points), centre=centre)
        return Target(cloud, Pyramid.build(cloud, config.grid), range_image(cloud.points, IMAGE_SIZE), centre)


def register(
    source: npt.ArrayLike,
    target: npt.ArrayLike | Target,
    initial_guess: FloatArray | None = None,
    config: RegistrationConfig | None = None,
) -> RegistrationResult:
    """Find T_target_source, the pose of the source's frame in the target's.

    Parameters
    ----------
    source, target
        Points, shape (..., 3) or, in the plane, (..., 2), m; NaN points are skipped. The target may be prepared
        beforehand.
    initial_guess
        T_target_source to start from, shape (4, 4); None searches.
    config
        Settings; the defaults serve rooms and vehicles alike.

    Clouds that cannot be registered have a result too: ``converged`` is False and ``reason`` says why.

    Raises
    ------
    ValueError
        For arrays of a wrong shape or a guess that is no rigid transform: errors of the program, not of the data.
    """
    config = config or RegistrationConfig()
    if initial_guess is not None and not is_rigid_transform(np.asarray(initial_guess, dtype=np.float64), 1e-4):
        raise ValueError(f"the initial guess must be a rigid transform (4, 4), got {initial_guess}")
    points = finite_points(source)
    config = for_dimension(config, planar=target.cloud.planar if isinstance(target, Target) else is_planar(target))
    try:
        check_cloud(points, "source", config)
        prepared = target if isinstance(target, Target) else Target.build(target, config)
    except DegenerateCloudError as error:
        return failure(str(error))
    cloud = prepare(points, config.source_points, planar=prepared.cloud.planar, centre=prepared.centre)
    guess = None if initial_guess is None else _shifted(np.asarray(initial_guess, dtype=np.float64), -prepared.centre)
    return register_cloud(cloud, prepared, guess, config)


class DegenerateCloudError(ValueError):
    """A cloud that no method could register: too few points, or all in one place."""


def check_cloud(points: FloatArray, name: str, config: RegistrationConfig) -> None:
    """Raise :class:`DegenerateCloudError` for points (n, 3) that cannot be registered."""
    if len(points) < config.min_points:
        raise DegenerateCloudError(
            f"the {name} has {len(points)} finite points, at least {config.min_points} are needed"
        )
    extent = largest_extent(points)
    if extent < _LEAST_EXTENT:
        raise DegenerateCloudError(f"all points of the {name} coincide")
    if not extent < _LARGEST_EXTENT:
        raise DegenerateCloudError(f"the {name} spans {extent:.3g} m: no length of it can be computed with")


def for_dimension(config: RegistrationConfig, *, planar: bool) -> RegistrationConfig:
    """The configuration, for scans (n, 2) with wide cells and few points in each: a laser scanner has but hundreds."""
    if not planar:
        return config
    wide = max(config.grid.relative_voxel_size, _PLANAR_VOXEL_SIZE)
    grid = replace(config.grid, relative_voxel_size=wide, min_points=min(config.grid.min_points, _PLANAR_CELL_POINTS))
    return replace(config, grid=grid, min_points=min(config.min_points, _PLANAR_SCAN_POINTS))


def register_cloud(
    source: Cloud, target: Target, guess: FloatArray | None, config: RegistrationConfig
) -> RegistrationResult:
    """:func:`register` of a cloud made ready, with a guess in coordinates about the target's centre."""
    scale = max(target.cloud.scale, 1e-6)
    views = Views(source, range_image(source.points, IMAGE_SIZE), target.cloud, target.image)
    answers: list[Answer] = []
    if guess is not None:
        T, start = guess, config.start_level
    elif config.search.enabled:
        answers = searched_minima(views, target.pyramid, config.rim_share, config.search)
        T, start = answers[0].candidate.T, 0
    else:
        T, start = np.eye(4), config.grid.levels - 1
    if answers and config.method == "ndt":
        optimum, iterations = answers[0].optimum, answers[0].iterations
    else:
        optimum, iterations = _aligned(source, target, T, start, scale, config)
    result = _result(source, target, optimum, iterations, judge(views, optimum).conflict, config)
    if answers and result.converged:
        return _without_ambiguity(result, [answer.candidate for answer in answers], target)
    return result


def _without_ambiguity(result: RegistrationResult, minima: list[Candidate], target: Target) -> RegistrationResult:
    """The result of a search, as a failure where it is not the only answer."""
    scale, best = max(target.cloud.scale, 1e-6), minima[0]
    centred = _shifted_covariance(result.covariance, -best.T[:3, :3] @ target.centre)
    centred = centred + spread_of_neighbours(minima, scale)
    reason = ambiguity_reason(best, minima[1:], centred, scale)
    if not reason and result.degenerate:
        reason = f"without a guess {result.reason}"
    else:
        centred = unknown(scale) if reason else centred
    covariance = _shifted_covariance(centred, best.T[:3, :3] @ target.centre)
    return replace(result, covariance=covariance, converged=not reason, reason=reason or result.reason)


def _aligned(
    source: Cloud, target: Target, T: FloatArray, start: int, scale: float, config: RegistrationConfig
) -> tuple[NdtOptimum, int]:
    """The optimum by the chosen method from a pose, with the derivatives of the NDT cost there, and the iterations."""
    if config.method == "ndt":
        return descend(source, target.pyramid, T, start, scale, config.rim_share)
    plane = config.method == "icp_plane"
    outcome = icp_align(
        source.points,
        target.icp(),
        T,
        scale,
        config.icp,
        coarse_points=COARSE_POINTS,
        plane=plane,
        planar=source.planar,
    )
    R, t = np.ascontiguousarray(outcome.T[:3, :3]), outcome.T[:3, 3].copy()
    layers = target.pyramid.layers(source, 0, len(source), config.rim_share)
    there = ndt_align(layers, R, t, planar_constraint(source.planar), scale, 0, 0.0)
    return there._replace(converged=outcome.converged), outcome.iterations


def _result(
    source: Cloud,
    target: Target,
    optimum: NdtOptimum,
    iterations: int,
    cost: float,
    config: RegistrationConfig,
) -> RegistrationResult:
    scale = max(target.cloud.scale, 1e-6)
    grids = target.pyramid.grids
    wider, limit = grids[min(1, len(grids) - 1)], 3.0 * grids[0].block_size
    fit = fit_to_grid(source.points, optimum.rotation, optimum.translation, grids[0], wider, limit)
    layers = target.pyramid.layers(source, 0, len(source), config.rim_share)
    uncertainty = sandwich(
        Curvature(optimum.hessian, optimum.majorant, fit.spurious_hessian, fit.spurious_majorant),
        _scatter(layers, optimum, scale, len(source) / len(target.cloud)),
        Extent(fit.centre, max(fit.radius, _LEAST_RADIUS * scale)),
        ScoreLoss(
            target.pyramid.layers(source, 0, COARSE_POINTS, config.rim_share),
            orthonormal_pose(optimum),
            clear_loss(config.uncertainty),
        ).loss,
        scale,
        planar_constraint(source.planar) > 0.0,
        config.uncertainty,
    )
    reason = _reason_of_failure(optimum, fit.overlap, cost)
    if reason and not 1.0 / _UNITS_APART < source.scale / scale < _UNITS_APART:
        reason = f"the source is {source.scale / scale:.2g} times as large as the target: is one of them in mm?"
    names = direction_names(uncertainty.free)
    covariance = uncertainty.covariance if not reason else unknown(scale)
    return RegistrationResult(
        T_target_source=_shifted(orthonormal_pose(optimum), target.centre),
        covariance=_shifted_covariance(covariance, optimum.rotation @ target.centre),
        converged=not reason,
        iterations=iterations,
        score=min(optimum.score / max(fit.overlap, 1e-9), 1.0),
        overlap=fit.overlap,
        inlier_rmse=fit.inlier_rmse,
        reason=reason or ("not determined: " + "; ".join(names) if names else ""),
        degenerate=names,
    )


def _scatter(layers: tuple[Layer, Layer], optimum: NdtOptimum, scale: float, density_ratio: float) -> FloatArray:
    """Covariance of the cost's gradient; blocks of both layers in cubes of one size and place."""
    (surfaces, places), (rims, rim_places) = (
        block_gradients(layer, optimum.rotation, optimum.translation) for layer in layers
    )
    size = layers[0].grid.block_size
    wide = round(layers[1].grid.block_size / size)
    all_places = np.concatenate([places, wide * rim_places])
    width = max(round(_SHARED_ERRORS * scale / size), 1)
    return gradient_scatter(np.concatenate([surfaces, rims]), all_places, width, density_ratio)


_SHARED_ERRORS = 1 / 8
"""Edge of the cubes whose points share errors of a depth camera, over the scale."""
_UNITS_APART = 100.0
"""Clouds of one place differ less in scale than so many times, unless their units do."""
_LEAST_RADIUS = 0.05
"""Spread of the matched points, over the scale, below which rotations would be measured against nothing."""


def _reason_of_failure(optimum: NdtOptimum, overlap: float, cost: float) -> str:
    if overlap < _MIN_OVERLAP:
        needed = 100 * _MIN_OVERLAP
        return f"only {100 * overlap:.0f} % of the source lie on the target, at least {needed:.0f} % are needed"
    if cost > _MAX_CONFLICT:
        return f"the source lies in space that the target saw as free (cost {cost:.2f}, at most {_MAX_CONFLICT:.2f})"
    if not optimum.converged:
        return "the steps did not become small within the allowed iterations"
    return ""


def failure(reason: str) -> RegistrationResult:
    """Result of a cloud that cannot be registered."""
    return RegistrationResult(np.eye(4), unknown(1.0), False, 0, 0.0, 0.0, 0.0, reason)


def _shifted(T: FloatArray, centre: FloatArray) -> FloatArray:
    """The transform in coordinates whose origin was at ``centre`` of both frames."""
    return make_transform(T[:3, :3], T[:3, 3] + centre - T[:3, :3] @ centre)


def _shifted_covariance(covariance: FloatArray, rotated_centre: FloatArray) -> FloatArray:
    """Covariance where the frame's origin is ``-rotated_centre`` (3,) away.

    A lever of kilometres costs digits that positive definiteness needs.
    """
    J = np.eye(6)
    J[:3, 3:] = skew(rotated_centre)
    shifted = J @ covariance @ J.T
    return np.asarray(0.5 * (shifted + shifted.T) + _ROUNDING * np.trace(shifted) * np.eye(6))
