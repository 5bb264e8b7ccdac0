# SPDX-License-Identifier: Apache-2.0
"""Point clouds: sensor_msgs/PointCloud2 from and to structured arrays; sensor_msgs/LaserScan to points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.messages.base import Message, MessageTypes
from slam_core.types import AnyArray, Float32Array

_ELEMENT = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_DATATYPE = {np.dtype(element): number for number, element in _ELEMENT.items()}

LANDMARK_DTYPE = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z")]
    + [("id", "<f8"), ("sightings", "<i4")]
    + [(f"cov_{axes}", "<f4") for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
)
"""Fields of every landmark cloud. PointCloud2 has no 64-bit integer: FLOAT64 holds an id exactly up to 2^53."""

FARTHEST_M = 1e5
"""No range sensor sees so far."""

_LARGEST_ID = 2**53


def cloud_message(types: MessageTypes, header: Message, cloud: AnyArray) -> Message:
    """sensor_msgs/PointCloud2 of a structured array, shape (n,) or, organised, (height, width)."""
    cloud = np.ascontiguousarray(cloud)
    height, width = cloud.shape if cloud.ndim == 2 else (1, len(cloud))
    step = cloud.dtype.itemsize
    return types.PointCloud2(
        header=header,
        height=height,
        width=width,
        fields=_fields(types, cloud.dtype),
        is_bigendian=False,
        point_step=step,
        row_step=width * step,
        data=types.octets(cloud),
        is_dense=bool(_is_dense(cloud)),
    )


def cloud_from_message(message: Message) -> AnyArray:
    """Structured array, shape (n,) or (height, width) if organised, with the fields of the message.

    Raises
    ------
    ValueError
        For fields beyond the point, rows beyond the data, or an unknown field type.
    """
    dtype = _dtype(message)
    height, width, row_step = int(message.height), int(message.width), int(message.row_step)
    row = width * dtype.itemsize
    data = np.frombuffer(message.data, dtype=np.uint8)
    if height > 1 and row_step < row:
        raise ValueError(f"point cloud row_step is {row_step} bytes but {width} points of {dtype.itemsize} need {row}")
    row_step = row_step if height > 1 else row
    if len(data) < height * row_step:
        raise ValueError(f"point cloud is truncated: {height * row_step} bytes announced, {len(data)} there")
    rows = data[: height * row_step].reshape(height, row_step)[:, :row]
    cloud = np.ascontiguousarray(rows).view(dtype).reshape(height, width)
    cloud = cloud if not message.is_bigendian else cloud.astype(dtype.newbyteorder("="))
    return cloud if height > 1 else cloud[0]


def points_message(types: MessageTypes, header: Message, points: AnyArray) -> Message:
    """PointCloud2 with x, y, z FLOAT32 of points (n, 3) or, organised, (height, width, 3)."""
    points = np.ascontiguousarray(points, dtype="<f4")
    dtype = np.dtype([(name, "<f4") for name in "xyz"])
    return cloud_message(types, header, points.view(dtype)[..., 0])


def points_from_message(message: Message) -> Float32Array:
    """Points x, y, z (n, 3) float32 of a cloud, NaN rows kept; an organised cloud is flattened row by row.

    Points beyond ``FARTHEST_M`` become NaN.

    Raises
    ------
    ValueError
        If the cloud has no x, y, z or contradicts itself.
    """
    cloud = cloud_from_message(message)
    names = cloud.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names]:
        raise ValueError(f"point cloud has no field {', '.join(missing)}; it has {', '.join(names) or 'none'}")
    points = np.empty((cloud.size, 3), np.float32)
    for axis, name in enumerate("xyz"):
        points[:, axis] = cloud[name].ravel()
    far = np.abs(points) > FARTHEST_M
    if far.any():
        points[far.any(axis=1)] = np.nan
    return points


def points_from_scan(message: Message) -> Float32Array:
    """Points x, y (n, 2) float32 of a laser scan in its own frame; NaN where no range was measured.

    Raises
    ------
    ValueError
        If the scan has no ranges, or its angles or limits are no numbers.
    """
    first, step = float(message.angle_min), float(message.angle_increment)
    nearest, farthest = float(message.range_min), float(message.range_max)
    ranges = np.asarray(message.ranges, dtype=np.float32)
    if not (np.isfinite([first, step, nearest]).all() and step != 0.0 and farthest > nearest):
        raise ValueError(
            f"a laser scan of angle_min {first}, angle_increment {step} and ranges from {nearest} to {farthest} has no "
            "points"
        )
    if ranges.ndim != 1 or len(ranges) == 0:
        raise ValueError("the laser scan has no ranges")
    measured = (ranges >= nearest) & (ranges <= min(farthest, FARTHEST_M))
    angles = first + step * np.arange(len(ranges))
    points = np.column_stack([np.cos(angles), np.sin(angles)]) * np.where(measured, ranges, np.nan)[:, None]
    return np.asarray(points, np.float32)


def landmark_cloud(
    types: MessageTypes,
    header: Message,
    positions: FloatArray,
    covariances: FloatArray,
    ids: npt.NDArray[np.int64],
    sightings: npt.NDArray[np.int32] | None = None,
) -> Message:
    """Landmarks for the eye and for tools: positions (n, 3) m, their marginal covariances (n, 3, 3) m2, ids, sightings.

    The exact numbers of a submap travel in its ``gaussian``.
    """
    if len(ids) and np.abs(ids).max() > _LARGEST_ID:
        raise ValueError(f"landmark ids must lie within +-2^53 to be sent, got {np.abs(ids).max()}")
    cloud = np.zeros(len(positions), dtype=LANDMARK_DTYPE)
    for i, name in enumerate("xyz"):
        cloud[name] = positions[:, i]
        for j in range(i, 3):
            cloud[f"cov_{name}{'xyz'[j]}"] = covariances[:, i, j]
    cloud["id"] = ids
    cloud["sightings"] = 0 if sightings is None else sightings
    return cloud_message(types, header, cloud)


def _fields(types: MessageTypes, dtype: np.dtype[np.void]) -> list[Message]:
    described = []
    for name in dtype.names or ():
        element, offset = dtype.fields[name][:2]  # type: ignore[index]
        base, shape = element.subdtype or (element, ())
        if base.newbyteorder("=") not in _DATATYPE:
            raise ValueError(f"point field '{name}' of type {base} has no PointField type")
        count = int(np.prod(shape, dtype=int))
        described.append(
            types.PointField(name=name, offset=int(offset), datatype=_DATATYPE[base.newbyteorder("=")], count=count)
        )
    return described


def _dtype(message: Message) -> np.dtype[np.void]:
    step = int(message.point_step)
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for f in message.fields:
        if f.datatype not in _ELEMENT:
            raise ValueError(f"point field '{f.name}' has unknown type {f.datatype}")
        element = np.dtype(order + _ELEMENT[f.datatype])
        count = max(int(f.count), 1)
        if int(f.offset) + count * element.itemsize > step:
            raise ValueError(f"point field '{f.name}' ends beyond the point of {step} bytes")
        names.append(f.name)
        formats.append(element if count == 1 else np.dtype((element, (count,))))
        offsets.append(int(f.offset))
    if not names:
        raise ValueError("point cloud has no fields")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _is_dense(cloud: AnyArray) -> bool:
    names = [name for name in "xyz" if name in (cloud.dtype.names or ())]
    return all(np.isfinite(cloud[name]).all() for name in names)
