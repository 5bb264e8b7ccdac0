# SPDX-License-Identifier: Apache-2.0
"""``stereo_self_calibration``: learns what the rectification of a pair is wrong by, and corrects for it where sure.

Row differences of matches give the field across the rows; pairs of moments the field along them
(:mod:`stereo_frontend.stereo.two_view_consistency`). Both are evidence on the same ten numbers
(:mod:`stereo_frontend.stereo.rectification_error`) and add up as normal equations
(:mod:`stereo_frontend.stereo.normal_equations`).

The rows are followed from the first frame on. Disparities are corrected only when the evidence is beyond doubt: a
correction without need harms. Where the calibration itself says by how much it errs (``slam calibrate`` does), no doubt
is left to judge: that is the prior of the field, and what the recording adds to it is used from the first moments on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, Float32Array
from stereo_frontend.stereo.matching import MatchingConfig
from stereo_frontend.stereo.normal_equations import EvidenceWindow, NormalEquations, sandwich_estimate
from stereo_frontend.stereo.rectification_error import PRIOR_SIGMA, RectificationError
from stereo_frontend.stereo.two_view_consistency import (
    StereoView,
    consistency_equations,
    match_views,
    row_equations,
)

_MIN_CHI_SQUARE = 36.0
"""Evidence against a perfect calibration from which disparities are corrected."""
_MIN_ROW_ERROR = 0.25
"""Row differences, root mean square over the image, from which rows are corrected, px."""
_MIN_FRAME_PAIRS = 4
"""Pairs of moments needed before disparities are corrected."""
_MIN_PARALLAX = 8.0
"""Median motion of keypoints between two moments that are compared, px."""
_MAX_GROUPS = 400
"""Pairs of moments remembered."""
_ROW_REACH = 2.0
"""Row difference looked for beyond the epipolar band while the rows are not known, px."""
_MIN_SIMILARITY = 0.85
"""Least scalar product of two moments' descriptors."""
_MAX_RATIO = 0.8
"""Most ratio of the best to the second-best distance."""

_SETTLED = 40
"""Pairs of moments after which a calibration that asks for no correction is taken to be good."""
_EVERY = 3
"""Frames of which one is learnt from then: it shows much the same keypoints as the others."""
_GROUP = 4
"""Consecutive pieces of evidence that are not independent: they share keypoints."""
_MIN_MATCHES = 30
"""Fewer matches say nothing."""
_HYSTERESIS = 0.5
"""A correction stays until what asks for it falls below this share of what it took to begin."""
_FREE = 3.0
"""Directions of the field's nine in which a calibration errs about freely: in the others its errors compensate."""


@dataclass(frozen=True)
class SelfCalibrationConfig(Config):
    """Limits of learning and of what is believed."""

    mode: str = parameter("auto", "correct where the evidence asks for it, or never", choices=("auto", "off"))
    sigma_disparity: float = parameter(
        0.0,
        "standard deviation of disparities by errors of the calibration, as slam calibrate writes it; 0: not known",
        unit="px",
        minimum=0.0,
        maximum=10.0,
    )
    row_floor: float = 0.1
    """Standard deviation of a perfect match's row difference, px."""


class StereoSelfCalibration:
    """Takes the matches of pair after pair; :attr:`error` is the estimate, :attr:`corrects` whether it is sure."""

    def __init__(self, config: SelfCalibrationConfig | None = None) -> None:
        self.config = config or SelfCalibrationConfig()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.error: RectificationError | None = None
        self.corrects_rows = self.corrects = self._is_significant = False
        self._reference: StereoView | None = None
        self._evidence = EvidenceWindow(_GROUP, _MAX_GROUPS)
        self._frame_pairs = self._views = 0

    # ---- what is known
    def widened(self, matching: MatchingConfig) -> MatchingConfig:
        """The matching for images whose rows are not known yet, and for keypoints that are found before that."""
        reach = 0.0 if self.config.mode == "off" else _ROW_REACH
        return replace(matching, epipolar_band=matching.epipolar_band + reach)

    def knows(self, camera: Camera) -> bool:
        """True if the rows of this camera's pair are known, or not asked for."""
        return self.config.mode == "off" or (self.error is not None and self.error.camera == camera)

    def rows(self, uv_right: Float32Array, disparity: AnyArray) -> Float32Array:
        """Error (n,) px across the rows at pixels (n, 2) of the right image; zeros where not significant."""
        if self.error is None or not self.corrects_rows:
            return np.zeros(len(uv_right), np.float32)
        return self.error.rows(uv_right, disparity).astype(np.float32)

    def columns(self, uv_right: Float32Array) -> tuple[FloatArray, FloatArray]:
        """Correction of disparities (n,) px with its standard deviation (n,) px; zeros while it is not significant."""
        if self.error is None or not self.corrects:
            return np.zeros(len(uv_right)), np.zeros(len(uv_right))
        return self.error.columns(uv_right), self.error.column_sigma(uv_right)

    def figures(self) -> dict[str, float | str]:
        """Figures for a summary; empty before the first pair."""
        if self.error is None:
            return {}
        return {
            "row_error_px": self.error.row_rms(),
            "disparity_error_px": self.error.column_rms(),
            "disparity_error_sigma_px": self.error.column_sigma_rms(),
            "corrected": ", ".join(["rows"] * self.corrects_rows + ["disparities"] * self.corrects) or "nothing",
        }

    def advice(self) -> str:
        """Advice to the user, or ""."""
        if self.error is None or not (self.corrects_rows or self._is_significant):
            return ""
        text = f"rectification off by {self.error.row_rms():.1f} px across the rows"
        if self._is_significant:
            sigma = self.error.column_sigma_rms()
            text += f" and {self.error.column_rms():.2f} +- {sigma:.2f} px along them, corrected"
        return f"{text}: recalibrate, or slam calibrate refine"

    # ---- what tells of it
    def acquire(self, view: StereoView) -> None:
        """Learn the rows of a first pair, matched with a wide band; starts anew."""
        self.reset()
        if self.config.mode == "off":
            return
        unknown = RectificationError.unknown(view.stereo.camera)
        rows = [row_equations(view, unknown, self.config.row_floor)] if len(view) >= _MIN_MATCHES else []
        self._estimate_error(self._estimate(rows, unknown.camera))

    def learn(self, view: StereoView) -> None:
        """Take in the matches of one pair; disparities and rows as measured, without any correction."""
        self._views += 1
        needless = (
            self._frame_pairs >= _SETTLED and not (self.corrects_rows or self.corrects) and self._views % _EVERY > 0
        )
        if self.error is None or len(view) < _MIN_MATCHES or needless:
            return
        if self._reference is None:
            self._take(view, row_equations(view, self.error, self.config.row_floor))
            return
        rows, columns = match_views(self._reference, view, _MIN_SIMILARITY, _MAX_RATIO)
        first, second = self._reference.select(rows), view.select(columns)
        stays = len(rows) >= _MIN_MATCHES and np.median(np.linalg.norm(first.uv - second.uv, axis=1)) < _MIN_PARALLAX
        if stays:
            return
        evidence = row_equations(view, self.error, self.config.row_floor)
        consistency = consistency_equations(first, second, self.error)
        if consistency is not None:
            evidence = evidence + consistency
            self._frame_pairs += 1
        self._take(view, evidence)

    def _take(self, view: StereoView, evidence: NormalEquations) -> None:
        self._reference = view
        self._evidence.add(evidence)
        self._estimate_error(self._estimate(list(self._evidence.sums), view.stereo.camera))

    def _estimate(self, evidence: list[NormalEquations], camera: Camera) -> RectificationError:
        """The solution of all groups of evidence, with the sandwich covariance."""
        unknown = RectificationError.unknown(camera)
        if not evidence:
            return unknown
        prior = np.diag(1.0 / PRIOR_SIGMA**2)
        if self.config.sigma_disparity > 0.0:
            prior += _FREE / self.config.sigma_disparity**2 * unknown.column_moment()
        return RectificationError(camera, *sandwich_estimate(evidence, prior))

    def _estimate_error(self, error: RectificationError) -> None:
        self.error = error
        slack = _HYSTERESIS if self.corrects_rows else 1.0
        rows = error.row_rms()
        self.corrects_rows = rows > slack * _MIN_ROW_ERROR and rows > slack * self._significant(error.row_sigma_rms())
        slack = _HYSTERESIS if self._is_significant else 1.0
        enough = self._frame_pairs >= _MIN_FRAME_PAIRS
        self._is_significant = enough and error.column_rms() > slack * self._significant(error.column_sigma_rms())
        self.corrects = self._is_significant or (enough and self.config.sigma_disparity > 0.0)

    def _significant(self, sigma: float) -> float:
        """Limit that an error of standard deviation ``sigma`` must exceed to be believed."""
        return float(np.sqrt(_MIN_CHI_SQUARE)) * sigma
