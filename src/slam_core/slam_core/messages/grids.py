# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids: nav_msgs/OccupancyGrid from and to arrays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.messages.base import Message, MessageTypes
from slam_core.messages.poses import pose_from_message, pose_message


def occupancy_message(
    types: MessageTypes, header: Message, cells: npt.NDArray[np.int8], resolution: float, T_map_grid: FloatArray
) -> Message:
    """Grid of cells (rows, columns) int8, -1 unknown, 0 free to 100 occupied; row 0 lies at the grid's lowest y."""
    rows, columns = cells.shape
    info = types.MapMetaData(
        map_load_time=header.stamp,
        resolution=float(resolution),
        width=columns,
        height=rows,
        origin=pose_message(types, T_map_grid),
    )
    flat = np.ascontiguousarray(cells, dtype=np.int8).ravel()
    return types.OccupancyGrid(header=header, info=info, data=types.signed_octets(flat))


def occupancy_from_message(message: Message) -> tuple[npt.NDArray[np.int8], float, FloatArray]:
    """Cells (rows, columns) int8, resolution (m) and T_map_grid of a grid.

    Raises
    ------
    ValueError
        If the data are not as many as the grid has cells.
    """
    shape = int(message.info.height), int(message.info.width)
    cells = np.array(message.data, dtype=np.int8)
    if cells.size != shape[0] * shape[1]:
        raise ValueError(f"an occupancy grid of {shape[1]} x {shape[0]} cells has {cells.size} values")
    return cells.reshape(shape), float(message.info.resolution), pose_from_message(message.info.origin)
