# SPDX-License-Identifier: Apache-2.0
"""Camera models: pinhole with the ROS distortion models, and the rectified stereo rig.

Pixels are (u, v), u to the right, v down, the centre of the top-left pixel at (0, 0). The optical frame is REP-103's:
x right, y down, z forward. ``depth`` is along z (REP-118), ``range`` along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam_core.geometry import FloatArray

MIN_DEPTH = 0.05
"""Nearest depth, m, at which a point counts as in front of a camera."""

DISTORTION_MODELS = ("none", "plumb_bob", "rational_polynomial", "equidistant")


@dataclass(frozen=True)
class Camera:
    """Intrinsics and distortion of one camera.

    ``distortion``: plumb_bob (k1 k2 p1 p2 k3), rational_polynomial (k1 k2 p1 p2 k3 k4 k5 k6), equidistant (k1 k2 k3 k4;
    Kannala and Brandt 2006). A rectified camera has the model "none".
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"image size must be positive, got {self.width} x {self.height} px")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"focal lengths must be positive and finite, got {self.fx}, {self.fy} px: is the camera calibrated?"
            )
        if self.distortion_model not in DISTORTION_MODELS:
            known = ", ".join(DISTORTION_MODELS)
            raise ValueError(f"unknown distortion model '{self.distortion_model}', known: {known}")
        if not np.isfinite(self.distortion).all():
            raise ValueError(f"distortion coefficients must be finite, got {self.distortion}")

    @property
    def K(self) -> FloatArray:
        """Camera matrix, shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def lens(self) -> FloatArray:
        """fx, fy, cx, cy (4,), px."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def is_rectified(self) -> bool:
        """True if straight lines stay straight: no distortion left."""
        if self.distortion_model == "equidistant":
            return False  # a fisheye even with all coefficients zero: the radius is the angle, not its tangent
        return self.distortion_model == "none" or not np.any(self.distortion)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) in the optical frame; NaN for points at or behind the camera."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return self.pixels_from_normalised(points[:, :2] / z[:, None])

    def unproject(self, pixels: FloatArray, depth: FloatArray) -> FloatArray:
        """Points (n, 3) in the optical frame of pixels (n, 2) at depth (n,) m along z."""
        xy = self.normalised_from_pixels(pixels)
        depth = np.asarray(depth, dtype=np.float64)
        return np.column_stack([xy * depth[:, None], depth])

    def pixels_from_normalised(self, xy: FloatArray) -> FloatArray:
        """Distorted pixels (n, 2) of ideal image-plane coordinates x/z, y/z, shape (n, 2)."""
        return self.distort(xy) * [self.fx, self.fy] + [self.cx, self.cy]

    def normalised_from_pixels(self, pixels: FloatArray) -> FloatArray:
        """Image-plane coordinates x/z, y/z of distorted pixels, shape (n, 2): the inverse, by Newton.

        NaN for pixels that no ray reaches: past the turning point of the radial polynomial, at 90 degrees and more.
        """
        distorted = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.is_rectified:
            return np.asarray(distorted)
        return self._undistort(distorted)

    def distort(self, xy: FloatArray) -> FloatArray:
        """Apply the distortion model to ideal image-plane coordinates, shape (n, 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        if self.is_rectified:
            return xy
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        ideal = xy * self._radial_scale(r2)[:, None]
        if self.distortion_model == "equidistant":
            return np.asarray(ideal)
        _, _, p1, p2 = (*self.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
        tangential = [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        return np.asarray(ideal + np.column_stack(tangential))

    def _radial_scale(self, r2: FloatArray) -> FloatArray:
        """Distorted over ideal radius, of squared ideal radii (n,)."""
        if self.distortion_model == "equidistant":
            k = (*self.distortion, 0.0, 0.0, 0.0, 0.0)
            r = np.sqrt(r2)
            t2 = np.square(np.arctan(r))
            theta_d = np.arctan(r) * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
            return np.where(r > 1e-12, theta_d / np.maximum(r, 1e-12), 1.0)
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *([0.0] * 8))[:8]
        return np.asarray((1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6))))

    def _undistort(self, distorted: FloatArray) -> FloatArray:
        xy = self._undistort_radially(distorted)
        step, tolerance = 1e-6, 1e-11
        step_x = np.array([step, 0.0])
        for _ in range(20):
            residual = self.distort(xy) - distorted
            if np.nanmax(np.abs(residual), initial=0.0) < tolerance:
                break
            jx = (self.distort(xy + step_x) - self.distort(xy - step_x)) / (2 * step)
            jy = (self.distort(xy + step_x[::-1]) - self.distort(xy - step_x[::-1])) / (2 * step)
            determinant = jx[:, 0] * jy[:, 1] - jx[:, 1] * jy[:, 0]
            determinant = np.where(determinant > 1e-9, determinant, np.nan)  # past the turning point: no ray
            dx = (jy[:, 1] * residual[:, 0] - jy[:, 0] * residual[:, 1]) / determinant
            dy = (jx[:, 0] * residual[:, 1] - jx[:, 1] * residual[:, 0]) / determinant
            xy = xy - np.column_stack([dx, dy])
        converged = np.abs(self.distort(xy) - distorted).max(axis=1, initial=0.0) < 1e-9
        return np.where(converged[:, None], xy, np.nan)

    def _undistort_radially(self, distorted: FloatArray) -> FloatArray:
        """Start of the inverse: the radial curve alone, up to its turning point, from a table."""
        ideal = np.tan(np.linspace(0.0, 1.565, 4000))
        curve = ideal * self._radial_scale(ideal**2)
        turning = int(np.argmax(np.append(np.diff(curve) <= 0.0, True))) + 1
        radius = np.linalg.norm(distorted, axis=1)
        scale = np.interp(radius, curve[:turning], ideal[:turning]) / np.maximum(radius, 1e-12)
        return np.asarray(distorted * np.where(radius > 1e-12, scale, 1.0)[:, None])


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Content of a sensor_msgs/CameraInfo, without ROS.

    camera: intrinsics K and distortion D of the *raw* image. R: (3, 3) rotation from the raw to the rectified optical
    frame. P: (3, 4) projection of the rectified image; ``P[0, 3] = -fx * baseline`` for the right camera of a pair,
    zero for the left one. A P of zeros (drivers that never rectify) means the raw K.
    """

    camera: Camera
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    P: FloatArray = field(default_factory=lambda: np.zeros((3, 4)))

    def __post_init__(self) -> None:
        R, P = np.asarray(self.R, dtype=np.float64), np.asarray(self.P, dtype=np.float64)
        if R.shape != (3, 3) or P.shape != (3, 4) or not (np.isfinite(R).all() and np.isfinite(P).all()):
            raise ValueError(f"camera info needs a finite R (3, 3) and P (3, 4), got shapes {R.shape} and {P.shape}")
        if not P[:, :3].any():
            P = np.column_stack([self.camera.K, P[:, 3]])
        if not R.any():
            R = np.eye(3)
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
            raise ValueError(f"camera info has an R that is no rotation: {R.tolist()}")
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "P", P)

    @property
    def rectified(self) -> Camera:
        """The camera of the rectified image: P without distortion, same size."""
        P, c = self.P, self.camera
        return Camera(c.width, c.height, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))

    @property
    def baseline(self) -> float:
        """Distance (m) to the left camera of the pair, ``-P[0, 3] / P[0, 0]``: zero for the left camera itself."""
        return float(-self.P[0, 3] / self.P[0, 0])

    @property
    def is_rectified(self) -> bool:
        """True if the raw image already is the rectified one: no distortion, no rotation, K equal to P."""
        same = np.allclose(self.P[:, :3], self.camera.K, atol=1e-6) and np.allclose(self.R, np.eye(3), atol=1e-9)
        return bool(self.camera.is_rectified and same)


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo pair: one camera model for both images and the baseline (m, positive)."""

    camera: Camera
    baseline: float

    def __post_init__(self) -> None:
        if not self.camera.is_rectified:
            raise ValueError("a StereoCamera is rectified: its camera must have no distortion")
        if not self.baseline > 0.0:
            raise ValueError(
                f"stereo baseline must be positive, got {self.baseline} m: are left and right swapped? "
                "The right camera_info must have P[0, 3] = -fx * baseline < 0"
            )

    def depth_from_disparity(self, disparity: FloatArray) -> FloatArray:
        """Depth (m) of disparities (px), ``d = f b / (u_left - u_right)`` (Eq. 4.4)."""
        return np.asarray(self.camera.fx * self.baseline / np.asarray(disparity))
