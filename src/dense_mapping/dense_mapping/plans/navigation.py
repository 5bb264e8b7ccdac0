# SPDX-License-Identifier: Apache-2.0
"""On a floor plan: where nobody has looked yet, and the way through free space from one place to another."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from slam_core.geometry import FloatArray

_REACH_M = 1.0
"""A place off the free cells is taken to be at the nearest one within this."""
_NARROW_COST = 0.3
"""Way (m) that is worth going to double a clearance of 1 m: keeps ways off the walls."""


@dataclass(frozen=True, eq=False)
class Frontier:
    """A border between free and unknown: ``point`` (3,) m in the map, on the border; ``length`` m."""

    point: FloatArray
    length: float


@dataclass(frozen=True, eq=False)
class Route:
    """A way through cells that were seen free: ``points`` (n, 3) m on the floor; length, least clearance, m."""

    points: FloatArray
    length: float
    clearance: float


def frontiers(plan: FloorPlan, min_length: float = 0.4) -> list[Frontier]:
    """Borders of the free space that are at least ``min_length`` m long, longest first."""
    free = plan.cells == FREE
    next_to_unknown = cv2.dilate((plan.cells == UNKNOWN).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    off_walls = cv2.dilate((plan.cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    border = (free & next_to_unknown & off_walls).astype(np.uint8)
    count, label = cv2.connectedComponents(border, connectivity=8)
    found = []
    for k in range(1, count):
        cells = np.argwhere(label == k)
        length = len(cells) * plan.resolution
        if length >= min_length:
            middle = cells[[np.argmin(np.square(cells - cells.mean(axis=0)).sum(axis=1))]]
            found.append(Frontier(plan.point_of(middle)[0], length))
    return sorted(found, key=lambda f: -f.length)


def plan_route(plan: FloorPlan, start: FloatArray, goal: FloatArray, half_width: float = 0.25) -> Route | None:
    """The way from ``start`` to ``goal`` (3,) m, map frame, for someone ``half_width`` m wide to each side.

    Where there is none so wide, it is looked for at half that width and at one cell; None if there is none at all.
    """
    clearance = _clearance(plan)
    for width in (half_width, 0.5 * half_width, 0.0):
        passable = (plan.cells == FREE) & (clearance >= width)
        ends = [_nearest(plan, passable, point) for point in (start, goal)]
        if ends[0] is None or ends[1] is None:
            continue
        cells = _shortest(passable, clearance, ends[0], ends[1], plan.resolution)
        if cells is not None:
            points = plan.point_of(cells)
            length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            return Route(points, length, float(clearance[cells[:, 0], cells[:, 1]].min()))
    return None


def walked(plan: FloorPlan, path: FloatArray, width: float = 0.5) -> FloorPlan:
    """The plan with what somebody has walked on as free, ``path`` (n, 3) m in the map, whatever was seen there.

    Cameras look ahead, not at one's feet, and take those who went before for obstacles.
    """
    trodden = np.zeros(plan.cells.shape, dtype=np.uint8)
    corners = plan.cell_of(path)[:, ::-1]
    thickness = max(1, round(width / plan.resolution))
    for a, b in itertools.pairwise(corners):
        if np.linalg.norm(b - a) * plan.resolution <= _REACH_M:  # else nobody knows what was between
            cv2.line(trodden, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1, thickness)
    return replace(plan, cells=np.where(trodden > 0, np.int8(FREE), plan.cells))


def _clearance(plan: FloorPlan) -> FloatArray:
    """Distance (rows, columns) m of each cell to the nearest one that is not free."""
    distance = cv2.distanceTransform((plan.cells == FREE).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(distance, dtype=np.float64) * plan.resolution


def _nearest(plan: FloorPlan, passable: npt.NDArray[np.bool_], point: FloatArray) -> tuple[int, int] | None:
    """Passable cell (row, column) nearest to a point of the map, within reach."""
    cells = np.argwhere(passable)
    if len(cells) == 0:
        return None
    distance = np.linalg.norm(cells - plan.cell_of(point[None])[0], axis=1) * plan.resolution
    nearest = int(np.argmin(distance))
    return (int(cells[nearest, 0]), int(cells[nearest, 1])) if distance[nearest] <= _REACH_M else None


def _shortest(
    passable: npt.NDArray[np.bool_], clearance: FloatArray, start: tuple[int, int], goal: tuple[int, int], size: float
) -> npt.NDArray[np.int64] | None:
    """Cells (n, 2) of the cheapest way over the eight neighbours (Dijkstra 1959), or None."""
    number = np.full(passable.shape, -1, dtype=np.int64)
    cells = np.argwhere(passable)
    number[passable] = np.arange(len(cells))
    cost = 1.0 + _NARROW_COST / np.maximum(clearance, size)
    edges = [_edges(number, cost[passable], size, dr, dc) for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1))]
    rows, columns, weights = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    graph = csr_matrix((weights, (rows, columns)), shape=(len(cells), len(cells)))
    first, last = int(number[start]), int(number[goal])
    distance, before = dijkstra(graph, directed=False, indices=first, return_predecessors=True)
    if not np.isfinite(distance[last]):
        return None
    chain = [last]
    while chain[-1] != first:
        chain.append(int(before[chain[-1]]))
    return np.asarray(cells[chain[::-1]])


def _edges(
    number: npt.NDArray[np.int64], cost: FloatArray, size: float, dr: int, dc: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """Pairs of passable cells that lie (dr, dc) apart, and what it costs to go from one to the other."""
    rows, columns = number.shape
    left, right = (0, columns - dc) if dc >= 0 else (-dc, columns)
    here, there = number[: rows - dr, left:right], number[dr:, left + dc : right + dc]
    both = (here >= 0) & (there >= 0)
    a, b = here[both], there[both]
    return a, b, 0.5 * (cost[a] + cost[b]) * size * np.hypot(dr, dc)
