"""Grids of normal distributions from fine to coarse over one cloud."""

from __future__ import annotations

from dataclasses import dataclass

from ndt_registration.cloud import Cloud
from ndt_registration.voxel_grid import NormalGrid, block_moments, coarser, normal_grid
from slam_core.config import Config, parameter


@dataclass(frozen=True)
class GridConfig(Config):
    """Cells of the Normal Distributions Transform; lengths follow from the cloud's scale unless they are set."""

    voxel_size: float = parameter(0.0, "edge of the finest cells, 0: from the cloud's scale", unit="m", minimum=0.0)
    relative_voxel_size: float = parameter(
        1 / 32, "edge of the finest cells over the scale", minimum=0.002, maximum=0.5
    )
    levels: int = parameter(5, "number of grids, each with cells twice as large", minimum=1, maximum=8)
    min_points: int = parameter(6, "fewest points of a cell", minimum=3)
    eigenvalue_floor: float = parameter(1e-3, "least eigenvalue over the largest (8.2.1)", minimum=1e-6, maximum=1.0)
    smoothing: float = parameter(0.1, "least standard deviation over the cell's edge", minimum=0.0, maximum=1.0)


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Grids from the finest to the coarsest."""

    grids: tuple[NormalGrid, ...]

    @staticmethod
    def build(cloud: Cloud, config: GridConfig) -> Pyramid:
        """Grids of a cloud: one pass over its points, then every level from the one below."""
        edge = config.voxel_size or config.relative_voxel_size * cloud.scale
        moments = block_moments(cloud.points, 0.5 * edge)
        grids = []
        for level in range(config.levels):
            size = edge * 2**level
            floor = (config.smoothing * size) ** 2
            grids.append(
                normal_grid(
                    moments,
                    0.5 * size,
                    min_points=config.min_points,
                    relative_floor=config.eigenvalue_floor,
                    variance_floor=floor,
                )
            )
            moments = coarser(moments)
        return Pyramid(tuple(grids))
