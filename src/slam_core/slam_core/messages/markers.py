# SPDX-License-Identifier: Apache-2.0
"""Pictures for RViz and Foxglove: covariance ellipsoids and paths as visualization_msgs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.estimation.chi_square import ELLIPSE_PROBABILITY, chi_square_bound
from slam_core.geometry import FloatArray, make_transform
from slam_core.messages.base import Message, MessageTypes
from slam_core.messages.poses import pose_message

Colour = tuple[float, float, float, float]


_ORANGE: Colour = (1.0, 0.55, 0.1, 0.35)
_BLUE: Colour = (0.1, 0.4, 1.0, 1.0)


def ellipsoid_markers(
    types: MessageTypes,
    header: Message,
    positions: FloatArray,
    covariances: FloatArray,
    ids: npt.NDArray[np.int64],
    *,
    namespace: str = "landmarks",
    colour: Colour = _ORANGE,
) -> Message:
    """MarkerArray of 99.5 % ellipsoids, which replaces the last one: positions (n, 3) m, covariances (n, 3, 3) m2."""
    clear = _marker(types, header, namespace, 0, action=3, pose=pose_message(types, np.eye(4)))
    shapes = _ellipsoids(covariances)
    spheres = [
        _marker(
            types,
            header,
            namespace,
            index,
            type=2,
            color=_colour(types, colour),
            scale=_vector(types, axes),
            pose=pose_message(types, make_transform(rotation, position)),
            text=str(int(landmark_id)),
        )
        for index, (landmark_id, position, rotation, axes) in enumerate(zip(ids, positions, *shapes, strict=True))
    ]
    return types.MarkerArray(markers=[clear, *spheres])


def path_marker(
    types: MessageTypes, header: Message, points: FloatArray, *, namespace: str = "path", colour: Colour = _BLUE
) -> Message:
    """A line strip through points (n, 3) m."""
    corners = [types.Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
    return _marker(
        types,
        header,
        namespace,
        0,
        type=4,
        points=corners,
        color=_colour(types, colour),
        scale=_vector(types, np.array([0.02, 0.0, 0.0])),
        pose=pose_message(types, np.eye(4)),
    )


def _ellipsoids(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) whose columns are the axes, and full lengths (n, 3) m of the axes."""
    eigenvalues, axes = np.linalg.eigh(np.asarray(covariances).reshape(-1, 3, 3))
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    factor = chi_square_bound(ELLIPSE_PROBABILITY, 3)
    return axes, 2.0 * np.sqrt(factor * np.maximum(eigenvalues, 0.0))


def _marker(types: MessageTypes, header: Message, namespace: str, index: int, **fields: Message) -> Message:
    return types.Marker(header=header, ns=namespace, id=index, **fields)


def _vector(types: MessageTypes, xyz: FloatArray) -> Message:
    return types.Vector3(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def _colour(types: MessageTypes, rgba: Colour) -> Message:
    return types.ColorRGBA(r=rgba[0], g=rgba[1], b=rgba[2], a=rgba[3])
