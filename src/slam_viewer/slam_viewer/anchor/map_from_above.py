# SPDX-License-Identifier: Apache-2.0
"""Walls, free floor and paths of a finished map, in the plane of its floor, to be laid on a floor plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, FloorPlan
from dense_mapping.plans.plan_io import read_plan
from sjsam_node.global_map import GlobalMap
from sjsam_node.map_file.storage import is_map
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray
from slam_viewer.page.run_folder import read_trajectories

PATH_COLOURS = ((200, 90, 20), (20, 130, 20), (180, 30, 160), (20, 140, 200))
"""BGR of the agents' paths, in turn."""
_LEAST_UPRIGHT = 0.3
"""Cosine of the tilt of the map against its floor from which x and y name no point of the floor."""
_LONG_SIDE = 1000
"""Pixels of a picture's longer side, at least."""
_MARGIN = 0.5
_COLOURS = {FREE: (255, 255, 255), OCCUPIED: (60, 40, 40)}


@dataclass(frozen=True, eq=False)
class MapFromAbove:
    """A map in the plane of its floor.

    ``T_map_floor`` (4, 4): a frame whose XY plane is the floor; without a floor plan that of the map itself.
    ``walls`` (n, 2) m in that frame: occupied cells, or landmarks where there is no floor plan.
    """

    folder: Path
    trajectories: dict[str, Trajectory]
    T_map_floor: FloatArray
    walls: FloatArray
    plan: FloorPlan | None
    storeys: int

    @classmethod
    def read(cls, path: Path, storey: int = 0) -> MapFromAbove:
        """The map of a finished run, or of a map folder; that of a run stands for the run.

        Raises
        ------
        ValueError
            If there is no map, or no such storey.
        """
        is_of_run = is_map(path) and (path.parent / "summary.json").is_file()
        folder = path.parent if is_of_run else path
        of_map = folder / "map" if is_map(folder / "map") else folder
        if not is_map(of_map):
            raise ValueError(f"{path} holds no map: slam run BAG -o {path} makes one")
        plans = sorted(folder.glob("floor_plan*.yaml"))
        if storey and storey >= len(plans):
            raise ValueError(f"{folder} has {len(plans)} floor plans, there is no storey {storey} (from 0)")
        snapshot = None
        trajectories = read_trajectories(folder) if (folder / "trajectory.tum").is_file() else {}
        if not plans or not trajectories:
            snapshot = GlobalMap.load(of_map).snapshot()
        if snapshot is not None and not trajectories:
            trajectories = {agent: Trajectory.from_estimates(poses) for agent, poses in snapshot.path().items()}
        if plans:
            plan = read_plan(plans[storey])
            occupied = np.argwhere(plan.cells == OCCUPIED)
            walls = np.asarray((occupied[:, ::-1] + 0.5) * plan.resolution, dtype=np.float64)
            return cls(folder, trajectories, plan.T_map_plan, walls, plan, len(plans))
        assert snapshot is not None
        return cls(folder, trajectories, np.eye(4), snapshot.landmarks().positions[:, :2], None, 0)

    def on_floor(self, points: FloatArray) -> FloatArray:
        """The points (n, 2) of the floor's frame over which the map's x and y (n, 2) are.

        Raises
        ------
        ValueError
            If the map lies so tilted that x and y say little of where on the floor a point is.
        """
        normal, corner = self.T_map_floor[:3, 2], self.T_map_floor[:3, 3]
        if normal[2] < _LEAST_UPRIGHT:
            raise ValueError("the z axis of the map does not point up: x and y of the map name no point of its floor")
        z = corner[2] - (points - corner[:2]) @ normal[:2] / normal[2]
        return transform_points(invert_transform(self.T_map_floor), np.column_stack([points, z]))[:, :2]

    def paths(self) -> dict[str, FloatArray]:
        """Places (n, 2) of every agent, in the floor's frame."""
        T = invert_transform(self.T_map_floor)
        return {agent: transform_points(T, t.poses[:, :3, 3])[:, :2] for agent, t in self.trajectories.items()}

    def picture(self) -> MapPicture:
        """The map from above, with walls, free floor, and the agents' paths."""
        low, high = self._bounds()
        longest = float((high - low).max())
        scale = max(1.0, np.ceil(_LONG_SIDE / longest * self._cell())) / self._cell()
        image = self._background(low, high, scale)
        picture = MapPicture(image, low, scale, self.T_map_floor)
        for (_, path), colour in zip(self.paths().items(), PATH_COLOURS * len(self.trajectories), strict=False):
            line = np.rint(picture.pixels(path) * 16).astype(np.int32)
            cv2.polylines(image, [line], False, colour, 2, cv2.LINE_AA, 4)
        return picture

    def _cell(self) -> float:
        return 0.05 if self.plan is None else self.plan.resolution

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        if self.plan is not None:
            return np.zeros(2), np.array(self.plan.cells.shape[::-1]) * self.plan.resolution
        places = np.concatenate([self.walls, *self.paths().values(), np.zeros((1, 2))])
        lowest, highest = np.percentile(places, [1.0, 99.0], axis=0)
        return lowest - _MARGIN, highest + _MARGIN

    def _background(self, low: FloatArray, high: FloatArray, scale: float) -> ByteArray:
        width, height = np.ceil((high - low) * scale - 1e-6).astype(int)
        if self.plan is None:
            image = np.full((height, width, 3), 255, dtype=np.uint8)
            for u, v in np.rint((self.walls - low) * scale).astype(int):
                cv2.circle(image, (int(u), height - int(v)), 2, (120, 110, 110), -1)
            return image
        cells = np.full((*self.plan.cells.shape, 3), 205, dtype=np.uint8)
        for value, colour in _COLOURS.items():
            cells[self.plan.cells == value] = colour
        return np.asarray(cv2.resize(cells[::-1], (int(width), int(height)), interpolation=cv2.INTER_NEAREST))


@dataclass(frozen=True, eq=False)
class MapPicture:
    """A picture of the map; its lower left corner is ``low`` (2,) m in the floor's frame, ``scale`` px/m."""

    image: ByteArray
    low: FloatArray
    scale: float
    T_map_floor: FloatArray

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2), from the upper left corner, of points (n, 2) of the floor's frame."""
        u, v = ((points - self.low) * self.scale).T
        return np.column_stack([u, self.image.shape[0] - v])

    def map_of_pixel(self) -> FloatArray:
        """The affine (2, 3) that takes a pixel (u, v, 1) to x and y of the map on its floor."""
        height = self.image.shape[0]
        floor_of_pixel = np.array(
            [[1.0, 0.0, self.low[0] * self.scale], [0.0, -1.0, height + self.low[1] * self.scale], [0.0, 0.0, 0.0],
             [0.0, 0.0, self.scale]]
        ) / self.scale  # fmt: skip
        return np.asarray(self.T_map_floor @ floor_of_pixel)[:2]
