# SPDX-License-Identifier: Apache-2.0
"""Camera models as functions of their parameters, with derivatives: what the bundle adjusts.

A lens is named by what is estimated: ``none``, ``plumb_bob4`` (k3 = 0), ``plumb_bob``, ``rational_polynomial``,
``equidistant``; its parameter vector is fx, fy, cx, cy and the distortion coefficients in ROS order.
"""

from __future__ import annotations

import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import FloatArray

DISTORTION_PARAMETERS: dict[str, tuple[str, ...]] = {
    "none": (),
    "plumb_bob4": ("k1", "k2", "p1", "p2"),
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}


def parameter_names(lens: str) -> tuple[str, ...]:
    """Names of a lens's parameters in the order of its vector.

    Raises
    ------
    ValueError
        If there is no such lens model.
    """
    if lens not in DISTORTION_PARAMETERS:
        raise ValueError(f"unknown lens model '{lens}', known: {', '.join(DISTORTION_PARAMETERS)}")
    return ("fx", "fy", "cx", "cy", *DISTORTION_PARAMETERS[lens])


def camera_from_parameters(lens: str, width: int, height: int, parameters: FloatArray) -> Camera:
    """The camera of a parameter vector."""
    fx, fy, cx, cy, *distortion = (float(v) for v in parameters)
    model = "plumb_bob" if lens == "plumb_bob4" else lens
    if lens == "plumb_bob4":
        distortion.append(0.0)
    return Camera(width, height, fx, fy, cx, cy, model, tuple(distortion))


def project_with_jacobians(
    lens: str, parameters: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of points with their derivatives.

    Parameters
    ----------
    lens
        Key of :data:`DISTORTION_PARAMETERS`.
    parameters
        Shape (p,).
    points
        In the optical frame, shape (n, 3), m, in front of the camera.

    Returns
    -------
    pixels (n, 2), derivative by the point (n, 2, 3), derivative by the parameters (n, 2, p)
    """
    fx, fy, cx, cy = parameters[:4]
    z = points[:, 2]
    xy = points[:, :2] / z[:, None]
    distorted, J_xy, J_coefficients = _distort(lens, parameters[4:], xy)
    focal = np.array([fx, fy])
    pixels = distorted * focal + [cx, cy]
    J_parameters = np.zeros((len(points), 2, len(parameters)))
    J_parameters[:, 0, 0], J_parameters[:, 1, 1] = distorted[:, 0], distorted[:, 1]
    J_parameters[:, 0, 2] = J_parameters[:, 1, 3] = 1.0
    J_parameters[:, :, 4:] = J_coefficients * focal[:, None]
    J_projection = np.zeros((len(points), 2, 3))
    J_projection[:, 0, 0] = J_projection[:, 1, 1] = 1.0 / z
    J_projection[:, :, 2] = -xy / z[:, None]
    return pixels, (J_xy * focal[:, None]) @ J_projection, J_parameters


def _distort(lens: str, k: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distorted image-plane points (n, 2), derivatives by ``xy`` (n, 2, 2) and by the coefficients (n, 2, len(k))."""
    if lens == "none":
        return xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2)), np.zeros((len(xy), 2, 0))
    if lens == "equidistant":
        return _distort_equidistant(k, xy)
    return _distort_polynomial(k, xy)


def _distort_polynomial(k: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Brown (1966) with the rational radial term of OpenCV."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([k, np.zeros(8 - len(k))])
    x, y = xy.T
    r2 = x * x + y * y
    numerator, denominator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    slope = ((k1 + r2 * (2 * k2 + r2 * 3 * k3)) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
    tangential = np.column_stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
    J = 2.0 * slope[:, None, None] * xy[:, :, None] * xy[:, None, :]
    J[:, 0, 0] += radial + 2 * p1 * y + 6 * p2 * x
    J[:, 1, 1] += radial + 6 * p1 * y + 2 * p2 * x
    J[:, 0, 1] += 2 * p1 * x + 2 * p2 * y
    J[:, 1, 0] += 2 * p1 * x + 2 * p2 * y
    powers = np.column_stack([r2, r2**2, r2**3])[:, None, :] * xy[:, :, None] / denominator[:, None, None]
    J_k = np.zeros((len(xy), 2, 8))
    J_k[:, :, [0, 1, 4]] = powers
    J_k[:, :, 5:8] = -radial[:, None, None] * powers
    J_k[:, :, 2] = np.column_stack([2 * x * y, r2 + 2 * y * y])
    J_k[:, :, 3] = np.column_stack([r2 + 2 * x * x, 2 * x * y])
    return xy * radial[:, None] + tangential, J, J_k[:, :, : len(k)]


def _distort_equidistant(k: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Kannala and Brandt (2006): the distorted radius is a polynomial of the angle off the axis."""
    r = np.maximum(np.linalg.norm(xy, axis=1), 1e-9)
    theta = np.arctan(r)
    odd = theta[:, None] ** np.array([3, 5, 7, 9])
    theta_d = theta + odd @ k
    slope = (1.0 + (theta[:, None] ** np.array([2, 4, 6, 8])) @ (k * [3, 5, 7, 9])) / (1.0 + r * r)
    scale = theta_d / r
    unit = xy / r[:, None]
    J = scale[:, None, None] * np.eye(2) + (slope - scale)[:, None, None] * unit[:, :, None] * unit[:, None, :]
    return xy * scale[:, None], J, unit[:, :, None] * odd[:, None, :]
