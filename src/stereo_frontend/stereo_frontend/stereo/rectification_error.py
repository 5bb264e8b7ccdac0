# SPDX-License-Identifier: Apache-2.0
"""Error that is left in a rectified stereo pair: a smooth field of small errors of the right image against the left.

A calibration errs in a few numbers of the right camera: where its axis points, its focal length, its lens. Each of
them moves the pixels of the right image along the rows and across them *together* (linear terms of the pinhole and
plumb_bob models, Hartley and Zisserman chapter 6; Brown 1966), with (x, y) = the ideal ray:

======== ========================= ===================== ==================================================
name      along the row, eu / f     across it, ev / f     error of the right camera
======== ========================= ===================== ==================================================
cx, cy   1, 0                      0, 1                  principal point, with what yaw and pitch add to it
yaw      x^2                       x y                   turned about its y axis
pitch    x y                       y^2                   turned about its x axis
roll     -y                        x                     turned about its optical axis
focal    x                         y                     relative error of the focal length
k1       x r^2                     y r^2                 radial distortion
p1       2 x y                     r^2 + 2 y^2           tangential distortion
p2       3 x^2 + y^2               2 x y                 tangential distortion
ty       0                         disparity / f         baseline not along the rows, rad
======== ========================= ===================== ==================================================

So row differences, which every match shows, tell most of what bends the disparities, which no single pair shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray

NAMES = ("cx", "cy", "yaw", "pitch", "roll", "focal", "k1", "p1", "p2", "ty")
PRIOR_SIGMA: FloatArray = np.array([0.005, 0.005, 0.02, 0.02, 0.01, 0.005, 0.01, 0.01, 0.01, 0.01])
"""By how much a calibration errs before anything is known of it: 1 degree, half a per cent, a few pixels."""
_GRID = np.linspace(0.05, 0.95, 9)


def column_basis(xy: FloatArray) -> FloatArray:
    """Derivative (n, 10) of eu / f by the parameters at rays (n, 2) of the right image."""
    x, y = xy[:, 0], xy[:, 1]
    r2, one, zero = x * x + y * y, np.ones_like(x), np.zeros_like(x)
    return np.column_stack([one, zero, x * x, x * y, -y, x, x * r2, 2 * x * y, r2 + 2 * x * x, zero])


def row_basis(xy: FloatArray, disparity: FloatArray) -> FloatArray:
    """Derivative (n, 10) of ev / f by the parameters at rays (n, 2) of the right image; ``disparity`` (n,) over f."""
    x, y = xy[:, 0], xy[:, 1]
    r2, one, zero = x * x + y * y, np.ones_like(x), np.zeros_like(x)
    return np.column_stack([zero, one, x * y, y * y, x, y, y * r2, r2 + 2 * y * y, 2 * x * y, disparity])


@dataclass(frozen=True, eq=False)
class RectificationError:
    """Estimate of the error of ``camera``'s pair: parameters (10,) in the order of ``NAMES``, covariance (10, 10)."""

    camera: Camera
    parameters: FloatArray
    covariance: FloatArray

    @classmethod
    def unknown(cls, camera: Camera) -> RectificationError:
        """No error, as far as is known."""
        return cls(camera, np.zeros(len(NAMES)), np.diag(PRIOR_SIGMA**2))

    @classmethod
    def from_text(cls, camera: Camera, text: str) -> RectificationError | None:
        """The error that :attr:`text` tells of, without its covariance; None for another text."""
        try:
            parameters = np.array([float(word) for word in text.split()])
        except ValueError:
            return None
        if parameters.shape != (len(NAMES),) or not np.isfinite(parameters).all():
            return None
        return cls(camera, parameters, np.zeros((len(NAMES), len(NAMES))))

    @property
    def text(self) -> str:
        """The parameters in words that give back every bit."""
        return " ".join(repr(float(value)) for value in self.parameters)

    def columns(self, uv_right: AnyArray) -> FloatArray:
        """Error (n,) px along the row at pixels (n, 2) of the right image: seen minus ideal column."""
        return np.asarray(self.camera.fx * column_basis(_rays(self.camera, uv_right)) @ self.parameters)

    def column_sigma(self, uv_right: AnyArray) -> FloatArray:
        """Standard deviation (n,) px of :meth:`columns`."""
        J = self.camera.fx * column_basis(_rays(self.camera, uv_right))
        return _sigmas(J, self.covariance)

    def rows(self, uv_right: AnyArray, disparity: AnyArray) -> FloatArray:
        """Error (n,) px across the rows at pixels (n, 2) of the right image, of ``disparity`` (n,) px."""
        basis = row_basis(_rays(self.camera, uv_right), disparity / self.camera.fx)
        return np.asarray(self.camera.fx * basis @ self.parameters)

    def row_rms(self) -> float:
        """Root mean square (px) of :meth:`rows` over the image, far away."""
        return _rms(self.parameters, _moments(self.camera)[0])

    def row_sigma_rms(self) -> float:
        """Standard deviation (px) of the same."""
        return _sigma_rms(self.covariance, _moments(self.camera)[0])

    def column_rms(self) -> float:
        """Root mean square (px) of :meth:`columns` over the image."""
        return _rms(self.parameters, self.column_moment())

    def column_sigma_rms(self) -> float:
        """Standard deviation (px) of the same."""
        return _sigma_rms(self.covariance, self.column_moment())

    def column_moment(self) -> FloatArray:
        """M (10, 10): the mean square (px2) of :meth:`columns` over the image is ``parameters^T M parameters``."""
        return _moments(self.camera)[1]


@lru_cache(maxsize=4)
def _moments(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Mean products (10, 10) px2 of the derivatives across and along the rows over the image, far away."""
    u, v = np.meshgrid(_GRID * camera.width, _GRID * camera.height)
    rays = _rays(camera, np.column_stack([u.ravel(), v.ravel()]))
    bases = camera.fx * row_basis(rays, np.zeros(len(rays))), camera.fx * column_basis(rays)
    across, along = (np.asarray(J.T @ J / len(J)) for J in bases)
    return across, along


def _rays(camera: Camera, uv: AnyArray) -> FloatArray:
    return (np.asarray(uv, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]


def _sigmas(J: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J)))


def _rms(parameters: FloatArray, moment: FloatArray) -> float:
    return float(np.sqrt(max(float(parameters @ moment @ parameters), 0.0)))


def _sigma_rms(covariance: FloatArray, moment: FloatArray) -> float:
    return float(np.sqrt(np.vdot(moment, covariance)))
