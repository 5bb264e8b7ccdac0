# SPDX-License-Identifier: Apache-2.0
"""``range_self_calibration``: learns how a range camera errs from the stereo pair beside it, and corrects for it.

Where both cameras see a feature, their depths differ by the error of :mod:`stereo_frontend.depth.range_error` and by
noise. The differences of frame after frame add up as normal equations (:mod:`stereo_frontend.stereo.normal_equations`).
Ranges are corrected only when the evidence is beyond doubt; from then on the uncertainty of the correction is part of
their standard deviation. The pair is the reference, its own errors included: what pulls a map is that the two
contradict each other.

So is what the model leaves unexplained. It is smooth over the image, so that neighbouring residuals agree about it,
which noise never does. Both stay with a place in the room: a landmark's sightings do not average them out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import DepthImage
from stereo_frontend.depth.range_error import RangeFields, dimension, prior_covariance
from stereo_frontend.stereo.normal_equations import (
    MEDIAN_CHI_SQUARE_1,
    EvidenceWindow,
    NormalEquations,
    robust_weights,
    sandwich_estimate,
)

_MIN_CHI_SQUARE = 36.0
"""Evidence against a perfect camera from which ranges are corrected."""
_MIN_ERROR = 0.003
"""Error, root mean square over the features, from which ranges are corrected, m."""
_MIN_VIEWS = 4
"""Views needed before that."""
_HYSTERESIS = 0.5
"""A correction stays until what asks for it falls below this share of what it took to begin."""
_MIN_CHANGE = 0.02
"""Median change of depth, relative, after which a view is another one."""
_MAX_GROUPS = 400
"""Views remembered."""
_GROUP = 5
"""Consecutive views that are not independent: they share landmarks."""
_MIN_FEATURES = 20
"""Fewer features say nothing."""
_NEIGHBOURS = 0.1
"""Features nearer than this share of the image's width are neighbours."""
_FORGETTING = 0.99
"""Weight of a view after the next one, in what neighbours share."""
_OUTLIER = 3.0
"""Residuals beyond so many standard deviations count as this large."""
_SIGHTINGS = 9.0
"""Sightings of a landmark that a filter takes for as many measurements, though their error is one and the same."""
_ITERATIONS = 5
_GRID = 8
"""Every so many pixels of a view are compared with the last one."""


@dataclass(frozen=True)
class RangeSelfCalibrationConfig(Config):
    """Mode of learning."""

    mode: str = parameter("auto", "correct ranges where the evidence asks for it, or never", choices=("auto", "off"))


@dataclass(frozen=True, eq=False)
class RangeDifferences:
    """Features that both cameras see.

    uv: (n, 2) px of the depth image. value, sigma: (n,) m along the ray, depth camera less stereo.
    """

    uv: FloatArray
    value: FloatArray
    sigma: FloatArray

    @classmethod
    def between(cls, uv: FloatArray, depths: FloatArray, sigmas: FloatArray, length: FloatArray) -> RangeDifferences:
        """Differences of depths (n, 2) m, the depth camera's and stereo's; ``length``: (n,) of the ray with depth 1.

        Disparities are compared, and the depth camera's range says what they are worth: stereo's own would weigh those
        that happen to be too short more than those that are too long.
        """
        depth, by_stereo = depths.T
        square = depth**2 * length
        value = square * (1.0 / by_stereo - 1.0 / depth)
        return cls(uv, value, np.hypot(sigmas[:, 0] * length, sigmas[:, 1] / by_stereo**2 * square))


class RangeSelfCalibration:
    """Takes what both cameras see, view after view; :attr:`corrects` says whether the estimate is sure."""

    def __init__(self, config: RangeSelfCalibrationConfig | None = None) -> None:
        self.config = config or RangeSelfCalibrationConfig()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.corrects = False
        self.error_m = self.sigma_m = 0.0
        """Error, root mean square over the features, and its standard deviation, m."""
        self._theta: FloatArray = np.zeros(0)
        self._covariance: FloatArray = np.zeros((0, 0))
        self._prior: FloatArray = np.zeros((0, 0))
        self._mean_amplitude = 0.0
        self._evidence = EvidenceWindow(_GROUP, _MAX_GROUPS)
        self._squares = EvidenceWindow(_GROUP, _MAX_GROUPS)
        """Squares of the rows in place of their information, with how many they are."""
        self._reference: FloatArray = np.zeros((0, 0))
        self._shared = self._weight = 0.0

    # ---- what is known
    @property
    def unexplained_m(self) -> float:
        """Standard deviation of what the correction leaves, at the camera's mean amplitude, m."""
        return float(np.sqrt(max(self._shared, 0.0) / self._weight)) if self._weight else 0.0

    def corrected(self, image: DepthImage, fields: RangeFields | None) -> DepthImage:
        """The image with its ranges corrected, or as it is where nothing is sure."""
        if fields is None or not self.corrects:
            return image
        factor = 1.0 - fields.error(self._theta) / fields.range
        return replace(image, depth=(image.depth * factor).astype(np.float32))

    def sigma(self, fields: RangeFields | None, uv: FloatArray) -> FloatArray:
        """Standard deviation (n,) m of ranges at pixels (n, 2) beside their noise, as if new in every sighting."""
        if fields is None or not self.corrects:
            return np.zeros(len(uv))
        rows = fields.rows(uv)
        variance = np.einsum("ni,ij,nj->n", rows, self._covariance, rows)
        return np.asarray(np.sqrt(_SIGHTINGS * (variance + self.unexplained_m**2 * fields.weakness_at(uv))))

    def figures(self) -> dict[str, float | str]:
        """Figures for a summary; empty before the first view."""
        if not self._evidence:
            return {}
        return {
            "error_mm": 1e3 * self.error_m,
            "error_sigma_mm": 1e3 * self.sigma_m,
            "unexplained_mm": 1e3 * self.unexplained_m,
            "corrected": "yes" if self.corrects else "no",
        }

    def advice(self) -> str:
        """Advice to the user, or ""."""
        if not self.corrects:
            return ""
        found = f"{1e3 * self.error_m:.0f} mm, corrected to {1e3 * self.unexplained_m:.0f} mm"
        return f"ranges of the depth camera are off by {found}: calibrate it, or look for what scatters its light"

    # ---- what tells of it
    def look(self, image: DepthImage) -> RangeFields | None:
        """Quantities that the error of each pixel depends on; None if they serve nothing."""
        if self.config.mode == "off" or not (self.corrects or self._has_changed(image)):
            return None
        if image.amplitude is not None and self._mean_amplitude == 0.0:
            lit = image.amplitude[np.isfinite(image.depth)]
            self._mean_amplitude = float(np.median(lit)) if len(lit) else 0.0
        known = self._mean_amplitude > 0.0
        return RangeFields.of(image if known else replace(image, amplitude=None), self._mean_amplitude)

    def learn(self, image: DepthImage, fields: RangeFields | None, seen: RangeDifferences) -> None:
        """Take in one view; ``seen`` is measured on the image as :meth:`corrected` gave it."""
        if fields is None or len(seen.uv) < _MIN_FEATURES or not self._has_changed(image):
            return
        self._reference = _grid(image)
        size = dimension(fields.has_amplitude)
        if len(self._theta) != size:
            self._begin(size)
        rows = fields.rows(seen.uv)
        value = seen.value + (rows @ self._theta if self.corrects else 0.0)
        self._evidence.add(self._equations(rows, value, seen.sigma**2))
        self._squares.add(NormalEquations(rows.T @ rows, np.array([len(rows)])))
        self._estimate_error()
        self._learn_unexplained(seen, value - rows @ self._theta, fields.weakness_at(seen.uv), image.camera.width)

    def _begin(self, size: int) -> None:
        self._evidence.clear()
        self._squares.clear()
        self.corrects = False
        self._theta, self._covariance = np.zeros(size), prior_covariance(size)
        self._prior = np.asarray(np.linalg.inv(self._covariance))

    def _has_changed(self, image: DepthImage) -> bool:
        """True if the view is another one than the last that was taken in."""
        grid = _grid(image)
        if self._reference.shape != grid.shape:
            return True
        change = np.abs(grid / self._reference - 1.0)
        change = change[np.isfinite(change)]
        return len(change) == 0 or bool(np.median(change) >= _MIN_CHANGE)

    def _equations(self, rows: FloatArray, value: FloatArray, variance: FloatArray) -> NormalEquations:
        """Evidence of one view, robust."""
        known, at = np.linalg.inv(self._covariance), self._theta
        theta = at
        for _ in range(_ITERATIONS):
            squares = (value - rows @ theta) ** 2 / variance
            noise = max(1.0, float(np.median(squares)) / MEDIAN_CHI_SQUARE_1)
            weighted = rows * robust_weights(squares, noise, variance)[:, None]
            evidence = NormalEquations(rows.T @ weighted, weighted.T @ value)
            theta = np.asarray(np.linalg.solve(evidence.information + known, evidence.vector + known @ at))
        return evidence

    def _estimate_error(self) -> None:
        """Estimate from all evidence, and judge it."""
        self._theta, self._covariance = sandwich_estimate(self._evidence.sums, self._prior)
        features = sum(float(s.vector[0]) for s in self._squares.sums)
        moment = np.sum([s.information for s in self._squares.sums], axis=0) / features
        self.error_m = float(np.sqrt(self._theta @ moment @ self._theta))
        self.sigma_m = float(np.sqrt(np.sum(moment * self._covariance)))
        slack = _HYSTERESIS if self.corrects else 1.0
        limit = slack * max(_MIN_ERROR, float(np.sqrt(_MIN_CHI_SQUARE)) * self.sigma_m)
        self.corrects = len(self._evidence) >= _MIN_VIEWS and self.error_m > limit

    def _learn_unexplained(
        self, seen: RangeDifferences, residual: FloatArray, weakness: FloatArray, width: int
    ) -> None:
        """Take in what residuals (n,) m of neighbours share; its variance grows with how weak their light is."""
        limit = _OUTLIER * np.sqrt(seen.sigma**2 + self.unexplained_m**2 * weakness)
        scale = np.sqrt(weakness)
        inside = np.clip(residual, -limit, limit)
        total, weight = _shared_by_neighbours(seen.uv, inside, scale, 1.0 / seen.sigma, _NEIGHBOURS * width)
        self._shared = _FORGETTING * self._shared + total
        self._weight = _FORGETTING * self._weight + weight


def _grid(image: DepthImage) -> FloatArray:
    return image.depth[::_GRID, ::_GRID].astype(np.float64)


@in_place()
def _shared_by_neighbours(uv, residual, scale, certainty, reach):  # type: ignore[no-untyped-def]
    """Sums over pairs of pixels (n, 2) nearer than ``reach``: residuals' products, and scales', both weighted."""
    total, weight = 0.0, 0.0
    for i in range(len(uv)):
        for j in range(i + 1, len(uv)):
            du, dv = uv[j, 0] - uv[i, 0], uv[j, 1] - uv[i, 1]
            if du * du + dv * dv < reach * reach:
                share = certainty[i] * certainty[j]
                total += share * residual[i] * residual[j]
                weight += share * scale[i] * scale[j]
    return total, weight
