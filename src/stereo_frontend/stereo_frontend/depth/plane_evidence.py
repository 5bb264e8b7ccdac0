# SPDX-License-Identifier: Apache-2.0
"""Distortion of a depth camera's depth, from the flat walls of single images.

A plane's inverse depth is affine in the pixel (:mod:`stereo_frontend.depth.depth_lookup`). Where depth errs by a factor
``1 + F`` that grows with the squares of column and row, the measured inverse depth ``i`` of a plane with parameters n
is ``i = n . ray (1 + F)``, linear in F at the n that fits best. Each plane gives normal equations of the two numbers of
F with its n eliminated; images add up, and their covariance is the sandwich estimate, as images that follow each other
show the same walls. No motion is needed: so an error of poses or pictures is not taken for one of depth.

What is not seen: a factor that is the same everywhere, which is the scale of the room, and one that is linear in the
pixel, which a tilt of the walls explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import DepthImage
from stereo_frontend.stereo.normal_equations import EvidenceWindow, NormalEquations, sandwich_estimate

PRIOR_SIGMA = 0.05
"""Standard deviation of both numbers before anything is seen, per squared x / z."""
_OBSERVABLE = 0.2
"""A number is observable if its standard deviation falls below this share of the prior's."""
_FLOOR = 0.002
"""Standard deviation that more images do not lower: bent walls, and pixels of the next wall among this one's.

In exact simulated corners the estimate is off by 0.001 to 0.002.
"""
_MIN_CHI_SQUARE = 36.0
"""Evidence against a flat response from which depth is corrected."""
_MIN_PLANES = 20
"""Fewer planes say nothing: a single bent thing is no camera's error."""
_GROUP = 5
"""Consecutive images that are not independent: they show the same walls."""
_MAX_IMAGES = 1000
_PIXELS = 6000
"""Most pixels of an image that are looked at."""
_PLANES, _TRIES, _SHARE = 4, 80, 0.05
"""Planes looked for in an image, hypotheses for each, and the least share of the pixels that one must hold."""
_REACH = 0.25
"""The three pixels of a hypothesis lie within so much of x / z and y / z of each other."""
_FEWEST = 30
"""Fewer pixels well inside a plane say nothing."""
_SIGMAS, _BEND = 4.0, 0.01
"""A pixel belongs to a plane within so many standard deviations, or this share of its inverse depth."""
_MARGIN = 3
"""Window of pixels that must all belong to the plane: near an edge they may be another wall's."""
_SMALLEST = 1e-4
"""Least determinant of three rays that give a plane."""

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class DistortionEstimate:
    """Numbers of columns and rows, per squared x / z and y / z, and what is believed of them; arrays are (2,).

    measured: as the planes have them. values: of these what is to be corrected, zeros else, with standard deviations
    sigma. is_observable: whether the planes tell of them at all. is_corrected: those that chi-square asks for and that
    each half of the images confirms of the other.
    """

    measured: FloatArray
    values: FloatArray
    sigma: FloatArray
    planes: int
    is_observable: npt.NDArray[np.bool_]
    is_corrected: npt.NDArray[np.bool_]


class PlaneEvidence:
    """Takes depth images; :meth:`estimate` is what their planes say. ``rng`` draws the hypotheses."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._evidence = EvidenceWindow(_GROUP, _MAX_IMAGES)
        self.planes = 0
        """Planes seen."""

    def add(self, image: DepthImage) -> None:
        """Take the planes of one image."""
        rays, inverse, sigma, shape = _pixels(image)
        left = np.flatnonzero(np.isfinite(inverse))
        found = []
        for _ in range(_PLANES):
            inliers = self._largest_plane(rays, inverse, sigma, left)
            if len(inliers) < _SHARE * _PIXELS:
                break
            left = np.setdiff1d(left, inliers, assume_unique=True)
            inside = _interior(inliers, shape)
            if len(inside) > _FEWEST:
                found.append(_equations(rays[inside], inverse[inside], sigma[inside]))
        if found:
            self.planes += len(found)
            self._evidence.add(sum(found[1:], start=found[0]))

    def estimate(self) -> DistortionEstimate:
        """The estimate of all images so far."""
        groups = list(self._evidence.sums)
        values, covariance = _solution(groups, np.ones(2, bool))
        variance = np.diag(covariance) + _FLOOR**2
        observable = (variance < (_OBSERVABLE * PRIOR_SIGMA) ** 2) & (self.planes >= _MIN_PLANES)
        asked = observable & (values**2 > _MIN_CHI_SQUARE * variance)
        halves = groups[: len(groups) // 2], groups[len(groups) // 2 :]
        if not (asked.any() and all(halves) and _confirms(*halves, asked) and _confirms(*halves[::-1], asked)):
            asked = np.zeros(2, bool)
        corrected, of_corrected = _solution(groups, asked)
        sigma = np.sqrt(np.where(asked, np.diag(of_corrected) + _FLOOR**2, variance))
        return DistortionEstimate(values, corrected, sigma, self.planes, observable, asked)

    def _largest_plane(self, rays: FloatArray, inverse: FloatArray, sigma: FloatArray, left: Rows) -> Rows:
        """Rows of the pixels of the plane that holds most of ``left``; none where there is no plane."""
        if len(left) < 3:
            return left[:0]
        limit = np.maximum(_SIGMAS * sigma, _BEND * inverse)
        planes = self._hypotheses(rays[left], inverse[left])
        held = np.abs(planes @ rays[left].T - inverse[left]) < limit[left]
        best = left[held[int(held.sum(axis=1).argmax())]] if len(planes) else left[:0]
        for _ in range(3):
            if len(best) < 3:
                return best
            plane, *_ = np.linalg.lstsq(rays[best], inverse[best], rcond=None)
            best = left[np.abs(rays[left] @ plane - inverse[left]) < limit[left]]
        return best

    def _hypotheses(self, rays: FloatArray, inverse: FloatArray) -> FloatArray:
        """Planes (k, 3) through three pixels each that are near each other."""
        first = self._rng.integers(len(rays), size=_TRIES)
        near = (np.abs(rays[first][:, None, :2] - rays[None, :, :2]) < _REACH).all(axis=2)
        drawn = np.where(near, self._rng.random(near.shape, np.float32), np.float32(2.0))
        three = np.argpartition(drawn, 2, axis=1)[:, :3]
        corners = rays[three]
        regular = (np.abs(np.linalg.det(corners)) > _SMALLEST) & (np.take_along_axis(drawn, three, 1).max(axis=1) < 2.0)
        return np.asarray(np.linalg.solve(corners[regular], inverse[three[regular]][..., None])[..., 0])


def _pixels(image: DepthImage) -> tuple[FloatArray, FloatArray, FloatArray, tuple[int, int]]:
    """Rays (n, 3), inverse depths (n,) 1/m and their standard deviations (n,) of a grid of that shape; NaN unknown."""
    step = int(np.ceil(np.sqrt(image.depth.size / _PIXELS)))
    v, u = np.mgrid[0 : image.depth.shape[0] : step, 0 : image.depth.shape[1] : step]
    depth, sigma = (a[::step, ::step].astype(np.float64).ravel() for a in (image.depth, image.sigma))
    known = (depth > 0.0) & (sigma > 0.0) & np.isfinite(sigma)
    depth = np.where(known, depth, np.nan)
    c = image.camera
    rays = np.column_stack([(u.ravel() - c.cx) / c.fx, (v.ravel() - c.cy) / c.fy, np.ones(u.size)])
    return rays, 1.0 / depth, sigma / depth**2, (u.shape[0], u.shape[1])


def _interior(inliers: Rows, shape: tuple[int, int]) -> Rows:
    """Inliers of a grid whose neighbours are inliers, too."""
    mask = np.zeros(shape, np.uint8)
    mask.ravel()[inliers] = 1
    kernel = np.ones((_MARGIN, _MARGIN), np.uint8)
    return np.flatnonzero(cv2.erode(mask, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1))


def _equations(rays: FloatArray, inverse: FloatArray, sigma: FloatArray) -> NormalEquations:
    """Evidence of one plane on the two numbers, its own three eliminated."""
    Q, _ = np.linalg.qr(rays / sigma[:, None])
    value = inverse / sigma
    rows = np.square(rays[:, :2]) * (Q @ (Q.T @ value))[:, None]
    rows -= Q @ (Q.T @ rows)
    return NormalEquations(rows.T @ rows, rows.T @ value)


def _solution(groups: list[NormalEquations], free: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Values (2,) and covariance (2, 2); what is not free is zero, with the prior's variance."""
    values, covariance = np.zeros(2), PRIOR_SIGMA**2 * np.eye(2)
    if groups:
        at = np.ix_(free, free)
        part = [NormalEquations(g.information[at], g.vector[free]) for g in groups]
        values[free], covariance[at] = sandwich_estimate(part, np.eye(int(free.sum())) / PRIOR_SIGMA**2)
    return values, covariance


def _confirms(one: list[NormalEquations], other: list[NormalEquations], free: npt.NDArray[np.bool_]) -> bool:
    """True if what one half says of the free numbers lowers the other half's misfit, each by itself and together."""
    values, _ = _solution(one, free)
    information, vector = sum(g.information for g in other), sum(g.vector for g in other)
    candidates = [values, *(np.where(np.arange(2) == j, values, 0.0) for j in np.flatnonzero(free))]
    return all(2.0 * v @ vector - v @ information @ v > 0.0 for v in candidates)
