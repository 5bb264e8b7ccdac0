# SPDX-License-Identifier: Apache-2.0
"""Grids of normal distributions from fine to coarse over one cloud."""

from __future__ import annotations

from dataclasses import dataclass

from ndt_registration.cloud import Cloud
from ndt_registration.ndt import Layer
from ndt_registration.voxel_grid import Moments, NormalGrid, adopt_planes, block_moments, coarser, normal_grid
from slam_core.config import Config, parameter


@dataclass(frozen=True)
class GridConfig(Config):
    """Cells of the Normal Distributions Transform; lengths follow from the cloud's scale unless they are set."""

    voxel_size: float = parameter(0.0, "edge of the finest cells, 0: from the cloud's scale", unit="m", minimum=0.0)
    relative_voxel_size: float = parameter(
        1 / 32, "edge of the finest cells over the scale", minimum=0.002, maximum=0.5
    )
    levels: int = parameter(5, "number of grids, each with cells twice as large", minimum=1, maximum=8)
    block_points: float = parameter(
        1.2, "mean points per eighth of a cell; sparser clouds get larger cells", minimum=0.0
    )
    min_points: int = parameter(6, "fewest points of a cell", minimum=3)
    eigenvalue_floor: float = parameter(1e-3, "least eigenvalue over the largest (8.2.1)", minimum=1e-6, maximum=1.0)
    surface_levels: int = parameter(2, "finest grids whose cells are surfaces that points may slide along", minimum=0)
    slack: float = parameter(
        10.0, "information taken off the cells of a surface, over that of its widest direction", minimum=0.0
    )
    flatness: float = parameter(
        2.0,
        "a cell takes the normal of the wider one whose variance across is at most so many times its own",
        minimum=0.0,
    )
    agreement: float = parameter(
        4.0, "and whose plane its own mean and normal meet within so many standard deviations", minimum=0.0
    )
    surface_smoothing: float = parameter(0.03, "like smoothing, on the surface levels", minimum=0.0)
    rim_ratio: float = parameter(2.0, "edge of the cells of rims over that of surfaces", minimum=0.1)
    rim_min_points: int = parameter(3, "fewest rim points of a cell", minimum=3)
    rim_blur: float = parameter(1.0, "growth of that from level to level", minimum=0.0)
    rim_smoothing: float = parameter(0.06, "like smoothing, for rims", minimum=0.0)
    smoothing: float = parameter(0.1, "least standard deviation over the cell's edge", minimum=0.0, maximum=1.0)


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
        while not config.voxel_size and edge < 0.25 * cloud.scale and surfaces.counts.mean() < config.block_points:
            surfaces, edge = coarser(surfaces), 2.0 * edge
        rims = block_moments(cloud.rims, 0.5 * config.rim_ratio * edge)
        surface_grids, rim_grids = [], []
        for level in range(config.levels):
            size = edge * 2**level
            surface_grids.append(_surface_grid(surfaces, size, level, config))
            rim_grids.append(_rim_grid(rims, config.rim_ratio * size, level, config))
            surfaces, rims = coarser(surfaces), coarser(rims)
        if not cloud.planar:  # where all lies in the plane, its normal is every cell's
            for level in range(config.levels - 2, -1, -1):
                slack = config.slack if level < config.surface_levels else -1.0
                floor = (config.surface_smoothing * edge * 2**level) ** 2
                adopt_planes(
                    surface_grids[level], surface_grids[level + 1], config.flatness, config.agreement, floor, slack
                )
        return Pyramid(tuple(surface_grids), tuple(rim_grids))

    def layers(self, source: Cloud, level: int, count: int, rim_share: float) -> tuple[Layer, Layer]:
        """What NDT needs on a level.

        At most ``count`` source points and their rims, which together weigh ``rim_share``.
        """
        points, rims = source.sample(count), source.sample_rims(count)
        factor = rim_share * len(points) / max(len(rims), _FEW_RIMS)
        return Layer(points, self.grids[level], 1.0), Layer(rims, self.rims[level], factor)


_FEW_RIMS = 30
"""Fewer rim points than this do not get the full weight of the rims."""


def _surface_grid(moments: Moments, size: float, level: int, config: GridConfig) -> NormalGrid:
    is_surface = level < config.surface_levels
    return normal_grid(
        moments,
        0.5 * size,
        min_points=config.min_points,
        relative_floor=config.eigenvalue_floor,
        variance_floor=((config.surface_smoothing if is_surface else config.smoothing) * size) ** 2,
        slack=config.slack if is_surface else 0.0,
    )


def _rim_grid(moments: Moments, size: float, level: int, config: GridConfig) -> NormalGrid:
    return normal_grid(
        moments,
        0.5 * size,
        min_points=config.rim_min_points,
        relative_floor=config.eigenvalue_floor,
        variance_floor=(config.rim_smoothing * size * (1.0 + config.rim_blur * level)) ** 2,
        slack=config.slack,
    )
