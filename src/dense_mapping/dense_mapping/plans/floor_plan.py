# SPDX-License-Identifier: Apache-2.0
"""Floor plans of a dense model: what is free, occupied, and not yet known, one for each storey.

A cell is occupied where the model has surface between knee and head, free where a ray from a camera went through it low
above the floor on its way to what it measured, and unknown otherwise. Where a camera itself has been is free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dense_mapping.keyframes import PlacedKeyframe, thinned
from dense_mapping.plans.levelling import floor_heights, level_transform, storey_of, up_direction
from dense_mapping.reconstruction.surface import Surface
from slam_core.camera import MIN_DEPTH
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, invert_transform, make_transform, transform_points
from slam_core.runtime.in_place import in_place

_CLEAR_BELOW = 0.6
"""Only rays lower than this above the floor make a cell free: a ray over a table does not."""
_MIN_COVER = 0.3
"""Surface above a cell, as a share of its own area, that makes it occupied."""
_MIN_RAYS = 2
"""Rays through a cell that make it free."""
RAY_STEP = 4
"""Every so many pixels a ray is drawn, px."""
_STOREY_HEIGHT = 2.0
"""Least height from one floor to the next."""
_MAX_CELLS = 25_000_000
"""A plan with more cells is not made."""

_ROWS_AT_ONCE = 1 << 14

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of nav_msgs/OccupancyGrid."""

Cells = npt.NDArray[np.int8]


@dataclass(frozen=True)
class FloorPlanConfig(Config):
    """The floor plan."""

    resolution: float = parameter(0.05, "edge of a cell", unit="m", minimum=0.01, maximum=1.0)
    lowest: float = parameter(0.15, "surface lower than this above the floor is no obstacle", unit="m", minimum=0.0)
    highest: float = parameter(1.9, "surface higher than this above the floor is no obstacle", unit="m", minimum=0.1)
    camera_height: float = parameter(
        1.3, "height of the cameras above the floor where no floor was seen", unit="m", minimum=0.0
    )


class Obstacles(NamedTuple):
    """Triangles of the model between floor and head: middles (n, 3) m and areas (n,) m2."""

    middles: FloatArray
    areas: FloatArray


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """One storey. ``cells`` (rows, columns) int8: -1 unknown, 0 free, 100 occupied; row 0 is the lowest y.

    ``T_map_plan``: pose of the corner of cell (0, 0), its X axis along the columns, its Y axis along the rows, its XY
    plane in the floor; ``resolution``: edge of a cell, m.
    """

    cells: Cells
    resolution: float
    T_map_plan: FloatArray

    def cell_of(self, points: FloatArray) -> npt.NDArray[np.int64]:
        """(row, column) (n, 2) of points (n, 3) of the map; may lie outside the plan."""
        local = transform_points(invert_transform(self.T_map_plan), points)
        return np.floor(local[:, [1, 0]] / self.resolution).astype(np.int64)

    def contains(self, cells: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """True if each (row, column) (n, 2) lies on the plan."""
        return np.asarray(((cells >= 0) & (cells < self.cells.shape)).all(axis=1))

    def point_of(self, cells: npt.NDArray[np.int64], height: float = 0.0) -> FloatArray:
        """Centres (n, 3) in the map of cells (row, column) (n, 2), ``height`` m above the floor."""
        x, y = (cells[:, 1] + 0.5) * self.resolution, (cells[:, 0] + 0.5) * self.resolution
        return transform_points(self.T_map_plan, np.column_stack([x, y, np.full(len(cells), height)]))

    def height_of(self, points: FloatArray) -> FloatArray:
        """Height (n,) m above the floor of points (n, 3) of the map."""
        return transform_points(invert_transform(self.T_map_plan), points)[:, 2]

    @property
    def free_m2(self) -> float:
        """Area that was seen free, m2."""
        return float((self.cells == FREE).sum() * self.resolution**2)


def floor_plans(
    surface: Surface,
    keyframes: Sequence[PlacedKeyframe],
    config: FloorPlanConfig | None = None,
    gravity_up: FloatArray | None = None,
) -> tuple[FloorPlan, ...]:
    """Plans of all storeys, lowest first; none for a model without key frames.

    ``gravity_up`` (3,): mean specific force in the map frame, where there is an IMU.

    Raises
    ------
    ValueError
        If the model reaches so far that a plan would have more than ``max_cells`` cells.
    """
    config = config or FloorPlanConfig()
    if not keyframes:
        return ()
    image_ups = np.stack([-k.T_map_camera[:3, 1] for k in keyframes])
    T_level_map = level_transform(up_direction(surface, image_ups, gravity_up))
    points = transform_points(T_level_map, surface.points.astype(np.float64))
    heights = _middles(points[:, 2:], surface.faces)[:, 0]
    poses = [T_level_map @ k.T_map_camera for k in keyframes]
    cameras = np.stack([T[:3, 3] for T in poses])
    floors = floor_heights(
        points, surface.normals @ T_level_map[:3, :3].T, cameras, _STOREY_HEIGHT, config.camera_height
    )
    storeys = storey_of(cameras, floors)
    plans = []
    for i, floor in enumerate(floors):
        own = np.flatnonzero(storeys == i).tolist()
        between = surface.faces[(heights > floor + config.lowest) & (heights < floor + config.highest)]
        rays = [_rays(keyframes[k], poses[k]) for k in own]
        if own:
            obstacles = Obstacles(_middles(points, between), _areas(points, between))
            plans.append(_plan(obstacles, rays, float(floor), config, T_level_map))
    return tuple(plans)


def _middles(points: FloatArray, faces: npt.NDArray[np.int32]) -> FloatArray:
    """Middles (n, k) of triangles, of the coordinates that ``points`` (m, k) have."""
    out = np.empty((len(faces), points.shape[1]))
    for part in _parts(len(faces)):
        a, b, c = (points[faces[part, k]] for k in range(3))
        out[part] = (a + b + c) / 3.0
    return out


def _areas(points: FloatArray, faces: npt.NDArray[np.int32]) -> FloatArray:
    """Areas (n,) of triangles."""
    out = np.empty(len(faces))
    for part in _parts(len(faces)):
        a, b, c = (points[faces[part, k]] for k in range(3))
        out[part] = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return out


def _parts(count: int) -> Iterator[slice]:
    """Rows at once: the corners of all triangles of a storey would take 100 MB, and the cache holds these."""
    return (slice(start, start + _ROWS_AT_ONCE) for start in range(0, count, _ROWS_AT_ONCE))


def _rays(placed: PlacedKeyframe, T_level_camera: FloatArray) -> FloatArray:
    """Starts and ends (n, 6) of the rays of a key frame; the end is two sigma before what was measured."""
    k = thinned(placed.keyframe, RAY_STEP)
    depth, sigma, camera = k.depth, k.sigma, k.camera
    v, u = np.nonzero(depth > 0.0)
    z = np.maximum(depth[v, u] - 2.0 * sigma[v, u], MIN_DEPTH).astype(np.float64)
    directions = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    ends = transform_points(T_level_camera, directions * z[:, None])
    return np.concatenate([np.tile(T_level_camera[:3, 3], (len(ends), 1)), ends], axis=1)


def _plan(
    obstacles: Obstacles, rays: list[FloatArray], floor: float, config: FloorPlanConfig, T_level_map: FloatArray
) -> FloorPlan:
    places = [obstacles.middles[:, :2], *(ends for ray in rays for ends in (ray[:, :2], ray[:, 3:5]))]
    lowest, highest = (np.array([edge(p, axis=0) for p in places if len(p)]) for edge in (np.min, np.max))
    low = np.floor(lowest.min(axis=0) / config.resolution) - 2.0
    shape = (np.ceil(highest.max(axis=0) / config.resolution) - low + 2.0).astype(np.int64)[::-1]
    if shape.prod() > _MAX_CELLS:
        raise ValueError(
            f"a floor plan of {shape[1]} x {shape[0]} cells of {config.resolution} m is more than max_cells "
            f"({_MAX_CELLS}): raise resolution"
        )
    corner = low * config.resolution
    through = np.zeros(tuple(shape), dtype=np.int32)
    band = np.array([floor - 0.5 * config.lowest, floor + _CLEAR_BELOW])
    for ray in rays:
        _trace(ray, corner, config.resolution, band, through)
    cells = np.where(through >= _MIN_RAYS, FREE, UNKNOWN).astype(np.int8)
    cells[_occupied(obstacles, corner, config, through.shape)] = OCCUPIED
    for ray in rays:
        if len(ray):
            column, row = np.floor((ray[0, :2] - corner) / config.resolution).astype(int)
            cells[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = FREE
    T_level_plan = make_transform(np.eye(3), np.array([*corner, floor]))
    return FloorPlan(cells, config.resolution, invert_transform(T_level_map) @ T_level_plan)


def _occupied(
    obstacles: Obstacles, corner: FloatArray, config: FloorPlanConfig, shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Cells in which the model has enough surface; a cell without an occupied neighbour is taken for noise.

    Counting the model's points instead would draw a table top as a grid: they lie 3 cm apart, the cells 5.
    """
    columns, rows = np.floor((obstacles.middles[:, :2] - corner) / config.resolution).astype(np.int64).T
    cover = np.bincount(rows * shape[1] + columns, obstacles.areas, shape[0] * shape[1]).reshape(shape)
    occupied = cover >= _MIN_COVER * config.resolution**2
    padded = np.pad(occupied, 1).astype(np.int8)
    around = sum(padded[i : i + shape[0], j : j + shape[1]] for i in range(3) for j in range(3))
    return np.asarray(occupied & (around > 1))


@in_place(error_model="numpy")
def _trace(
    rays: FloatArray, corner: FloatArray, resolution: float, band: FloatArray, through: npt.NDArray[np.int32]
) -> None:  # pragma: no cover - compiled
    """Count the rays (n, 6) through each cell at heights within ``band`` (2,), in steps of half a cell."""
    for r in range(rays.shape[0]):
        dx, dy = rays[r, 3] - rays[r, 0], rays[r, 4] - rays[r, 1]
        dz = rays[r, 5] - rays[r, 2]
        steps = int(np.sqrt(dx * dx + dy * dy) / (0.5 * resolution)) + 1
        last = -1
        for k in range(steps + 1):
            f = k / steps
            z = rays[r, 2] + f * dz
            if z < band[0] or z > band[1]:
                continue
            column = int((rays[r, 0] + f * dx - corner[0]) / resolution)
            row = int((rays[r, 1] + f * dy - corner[1]) / resolution)
            cell = row * through.shape[1] + column
            if cell != last and 0 <= row < through.shape[0] and 0 <= column < through.shape[1]:
                through[row, column] += 1
                last = cell
