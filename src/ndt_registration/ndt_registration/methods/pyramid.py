# SPDX-License-Identifier: Apache-2.0
"""Grids of normal distributions from fine to coarse over one cloud."""

from __future__ import annotations

from dataclasses import dataclass

from ndt_registration.clouds.cloud import Cloud
from ndt_registration.clouds.moments import Moments, block_moments, coarser
from ndt_registration.clouds.voxel_grid import NormalGrid, adopt_planes, normal_grid, note_spurious_information
from ndt_registration.methods.ndt import Layer
from slam_core.config import Config, parameter

_LEAST_COVERAGE = 0.5
"""Least share of a cloud in cells that hold enough points: sparser clouds get larger cells."""
_WIDEST = 0.25
"""Cells this wide, over the scale, are not made wider for that."""
_EIGENVALUE_FLOOR = 1e-3
"""Least eigenvalue over the largest (8.2.1)."""
_SURFACE_LEVELS = 2
"""Finest grids whose cells are surfaces that points may slide along."""
_SLACK = 10.0
"""Information taken off the cells of a surface, over that of its widest direction."""
_AGREEMENT = 4.0
"""Standard deviations within which its mean and normal must meet the other's plane."""
_SURFACE_SMOOTHING = 0.03
"""Like smoothing, on the surface levels."""
_RIM_RATIO = 2.0
"""Edge of the cells of rims over that of surfaces."""
_RIM_MIN_POINTS = 3
"""Fewest rim points of a cell."""
_RIM_BLUR = 1.0
"""Growth of that from level to level."""
_RIM_SMOOTHING = 0.06
"""Like smoothing, for rims."""
_SMOOTHING = 0.1
"""Least standard deviation over the cell's edge."""


@dataclass(frozen=True)
class GridConfig(Config):
    """Cells of the Normal Distributions Transform; lengths follow from the cloud's scale unless they are set."""

    voxel_size: float = parameter(0.0, "edge of the finest cells, 0: from the cloud's scale", unit="m", minimum=0.0)
    relative_voxel_size: float = 1 / 32
    """Edge of the finest cells over the scale."""
    levels: int = parameter(5, "number of grids, each with cells twice as large", minimum=1, maximum=8)
    min_points: int = 6
    """Fewest points of a cell."""
    flatness: float = 2.0
    """A cell takes the normal of the wider one whose variance across is at most so many times its own."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Grids of surfaces and of rims, from the finest to the coarsest."""

    grids: tuple[NormalGrid, ...]
    rims: tuple[NormalGrid, ...]

    @staticmethod
    def build(cloud: Cloud, config: GridConfig) -> Pyramid:
        """Grids of a cloud: one pass over its points, then every level from the one below."""
        edge = config.voxel_size or config.relative_voxel_size * cloud.scale
        surfaces = block_moments(cloud.points, 0.5 * edge)
        finest = _surface_grid(surfaces, edge, 0, config)
        while not config.voxel_size and edge < _WIDEST * cloud.scale and _coverage(finest, cloud) < _LEAST_COVERAGE:
            surfaces, edge = coarser(surfaces), 2.0 * edge
            finest = _surface_grid(surfaces, edge, 0, config)
        rims = block_moments(cloud.rims, 0.5 * _RIM_RATIO * edge)
        surface_grids, rim_grids = [finest], [_rim_grid(rims, _RIM_RATIO * edge, 0)]
        for level in range(1, config.levels):
            surfaces, rims = coarser(surfaces), coarser(rims)
            surface_grids.append(_surface_grid(surfaces, edge * 2**level, level, config))
            rim_grids.append(_rim_grid(rims, _RIM_RATIO * edge * 2**level, level))
        if not cloud.planar:  # where all lies in the plane, its normal is every cell's
            for level in range(config.levels - 2, -1, -1):
                slack = _SLACK if level < _SURFACE_LEVELS else -1.0
                floor = (_SURFACE_SMOOTHING * edge * 2**level) ** 2
                adopt_planes(surface_grids[level], surface_grids[level + 1], config.flatness, _AGREEMENT, floor, slack)
        note_spurious_information(surface_grids[0])
        return Pyramid(tuple(surface_grids), tuple(rim_grids))

    def layers(self, source: Cloud, level: int, count: int, rim_share: float) -> tuple[Layer, Layer]:
        """Layers of NDT on a level.

        At most ``count`` source points and their rims, which together weigh ``rim_share``.
        """
        points, rims = source.sample(count), source.sample_rims(count)
        factor = rim_share * len(points) / max(len(rims), _FEW_RIMS)
        return Layer(points, self.grids[level], 1.0), Layer(rims, self.rims[level], factor)


_FEW_RIMS = 30
"""Fewer rim points than this do not get the full weight of the rims."""


def _coverage(grid: NormalGrid, cloud: Cloud) -> float:
    """Share of the cells around the points of a cloud, eight each, that are in the grid, as it was made."""
    return float(grid.counts.sum() / max(8 * len(cloud), 1))


def _surface_grid(moments: Moments, size: float, level: int, config: GridConfig) -> NormalGrid:
    is_surface = level < _SURFACE_LEVELS
    return normal_grid(
        moments,
        0.5 * size,
        min_points=config.min_points,
        relative_floor=_EIGENVALUE_FLOOR,
        variance_floor=((_SURFACE_SMOOTHING if is_surface else _SMOOTHING) * size) ** 2,
        slack=_SLACK if is_surface else 0.0,
    )


def _rim_grid(moments: Moments, size: float, level: int) -> NormalGrid:
    return normal_grid(
        moments,
        0.5 * size,
        min_points=_RIM_MIN_POINTS,
        relative_floor=_EIGENVALUE_FLOOR,
        variance_floor=(_RIM_SMOOTHING * size * (1.0 + _RIM_BLUR * level)) ** 2,
        slack=_SLACK,
    )
