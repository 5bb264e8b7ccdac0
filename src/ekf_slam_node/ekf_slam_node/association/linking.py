# SPDX-License-Identifier: Apache-2.0
"""Linking a frame to what is known.

Association under the prediction, or under a motion guess where the prediction fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.association.association import (
    IndexArray,
    associate_ccda,
    associate_jcbb,
    associate_mahalanobis,
    associate_nearest,
    match_descriptors,
    same_tracks,
    wrong_pair_variance,
)
from ekf_slam_node.association.motion_guess import MotionGuess, guess_motion, refine_motion
from ekf_slam_node.association.two_motions import MovingTracks, two_motions
from ekf_slam_node.config import FeatureAssociationConfig
from ekf_slam_node.filtering.candidates import Candidates, MotionPrior
from ekf_slam_node.filtering.models import Frame
from slam_core.estimation.least_squares import median
from slam_core.geometry import FloatArray

_MIN_INLIER_RATIO = 0.2
"""Inliers among the descriptor matches below which a motion guess is not trusted."""
_GUESS_MIN_INLIERS = 12
"""Associations a motion guess from descriptors alone needs."""
_GUESS_RATIO = 0.85
"""A match of a motion guess needs a second best whose descriptor distance is larger by 1 / this."""
_GUESS_DESCRIPTOR_THRESHOLD = 0.6
"""Least cosine of the descriptors in the second attempt at a motion guess."""
_FOLLOWED = 0.3
"""Share of the features, or of the candidates where these are fewer, that must have been followed to rely on tracks."""
_TRACK_HYPOTHESES = 30
"""Samples drawn for the motion of tracks, few of which are wrong."""
_HYPOTHESES = 200
"""Samples drawn for the motion guess."""
_ALIKE = 0.5
"""Features on moving things, over those linked, from which on it is not sure which of them belong to the room."""
_MAX_GATE_PX = 80.0
"""Prediction uncertainty (one sigma in the image) above which the prediction is not tried, px."""

_METHODS = {"mahalanobis": associate_mahalanobis, "jcbb": associate_jcbb, "ccda": associate_ccda}
CONVINCING = 0.5
"""Share of the features, or of the candidates where these are fewer, that a right prediction links."""


@dataclass(frozen=True, eq=False)
class FrameLink:
    """Pairs of candidates ``rows`` and features ``columns`` (k,), and the motion they agree on.

    T, covariance: (4, 4) T_previous_now from these pairs alone, with its covariance (6, 6). excess: (3,) by what
    factors the pairs' errors exceed their claimed variances. error: (k, 3) measured less predicted of each pair. wrong:
    (n, 3) variance of the frame's n features for wrong pairs, or None where the association lets hardly any through.
    moving: how many features are on things that move. is_sure: by number and size it is clear which features these are.
    """

    T: FloatArray
    covariance: FloatArray
    variance_scale: FloatArray
    rows: IndexArray
    columns: IndexArray
    error: FloatArray
    wrong: FloatArray | None = None
    moving: int = 0
    is_sure: bool = True


class Linker:
    """Associates one frame after the other.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera, (4, 4).
    """

    def __init__(self, config: FeatureAssociationConfig, T_rig_optical: FloatArray) -> None:
        self._config = config
        self._T_rig_optical = T_rig_optical
        self._moving = MovingTracks()
        self._variance_scale = np.ones(3)

    def link(
        self,
        candidates: Candidates,
        frame: Frame,
        prior: MotionPrior,
        is_refuted: Callable[[FrameLink], bool] = lambda link: False,
        maps: bool = True,
    ) -> FrameLink | None:
        """Pairs of candidates and features and their motion; None if the frame cannot be linked.

        ``is_refuted`` is asked of what looks alone have found: places may look the same. ``maps``: False for a frame
        that tells the pose alone, whose tracks do without other pairs and without their depths' word on the noise.
        """
        if min(len(candidates), len(frame)) < self._config.min_inliers:
            return None
        # Seeded by the frame's own stamp: the samples do not depend on what happened before.
        rng = np.random.default_rng((self._config.seed, frame.stamp_ns))
        predicted = self._by_tracks(candidates, frame, prior, rng, maps)
        if predicted is not None and maps:
            smaller = np.minimum(predicted.variance_scale, 1.0)
            self._variance_scale = 0.9 * self._variance_scale + 0.1 * smaller
        if predicted is None:
            predicted = self._by_prediction(candidates, frame, prior, rng)
        known = min(len(candidates), len(frame))
        if predicted is not None and (predicted.moving or len(predicted.rows) >= CONVINCING * known):
            return predicted
        # A prediction that is wrong and sure of itself finds the few pairs that agree with it: looks alone decide.
        guessed = self._by_guess(candidates, frame, rng, is_refuted)
        return max((link for link in (predicted, guessed) if link is not None), key=_number_of_pairs, default=None)

    def link_at(
        self, candidates: Candidates, frame: Frame, prior: MotionPrior, variance_scale: FloatArray
    ) -> FrameLink | None:
        """The pairs inside the gates of a motion that another sensor tells, and the motion that they agree on.

        The gates are those of the features' true noise, by ``variance_scale`` (3,) smaller than what they claim: what
        moves slowly hides in the difference.
        """
        config, tight = self._config, frame.with_larger_noise(np.minimum(variance_scale, 1.0))
        rows, columns = self._associate(candidates, tight, prior)
        rng = np.random.default_rng((config.seed, frame.stamp_ns))
        pairs = candidates.places(rows), tight.places(columns)
        guess = guess_motion(*pairs, self._T_rig_optical, rng, _HYPOTHESES, config.gate, prior.T)
        if guess is None:
            return None
        rows, columns = rows[guess.inliers], columns[guess.inliers]
        return self._link_of(candidates, frame, guess.T, rows, columns, config.min_inliers)

    def mark_moving(self, frame: Frame, columns: IndexArray) -> None:
        """Do not use the tracks of features ``columns`` (k,) again: they are on something that moves."""
        self._moving.mark(frame.tracks[columns])

    def _by_tracks(
        self, candidates: Candidates, frame: Frame, prior: MotionPrior, rng: np.random.Generator, maps: bool
    ) -> FrameLink | None:
        """The pairs that the front end has followed, and what of the rest fits their motion; None if these are few."""
        config = self._config
        rows, columns = same_tracks(candidates.tracks, frame.tracks)
        if len(rows) < max(config.min_inliers, _FOLLOWED * min(len(candidates), len(frame))):
            return None
        still = ~self._moving.marks(frame.tracks[columns])
        marked = int(np.sum(~still))
        rows, columns = rows[still], columns[still]
        two = two_motions(
            candidates, frame, (rows, columns), self._T_rig_optical, rng, config.gate, config.min_inliers,
            self._variance_scale, prior.T,
        )  # fmt: skip
        if two is not None:
            rows, columns = two.rows, two.columns
            if maps:
                self.mark_moving(frame, two.moving)
        followed = candidates.places(rows), frame.places(columns)
        initial = prior.T if two is None else two.T
        guess = guess_motion(*followed, self._T_rig_optical, rng, _TRACK_HYPOTHESES, config.gate, initial)
        if guess is None or guess.inliers.sum() < max(config.min_inliers, 0.5 * len(rows)):
            return None
        if maps:
            more = self._of_the_rest(candidates, frame, guess, rows, columns)
            rows, columns = np.concatenate([rows, more[0]]), np.concatenate([columns, more[1]])
        link = self._link_of(candidates, frame, guess.T, rows, columns, config.min_inliers)
        if link is None:
            return None
        moving = marked + (0 if two is None else len(two.moving))
        is_sure = moving < _ALIKE * len(link.rows) and (two is None or two.is_larger)
        return replace(link, moving=moving, is_sure=is_sure)

    def _of_the_rest(
        self, candidates: Candidates, frame: Frame, guess: MotionGuess, rows: IndexArray, columns: IndexArray
    ) -> tuple[IndexArray, IndexArray]:
        """Pairs of candidates and features of no common track, which a new track may have in sight again."""
        is_free_row, is_free_column = ~self._moving.marks(candidates.tracks), ~self._moving.marks(frame.tracks)
        is_free_row[rows], is_free_column[columns] = False, False
        free_rows, free_columns = np.flatnonzero(is_free_row), np.flatnonzero(is_free_column)
        if min(len(free_rows), len(free_columns)) == 0:
            return rows[:0], columns[:0]
        noisier = frame.select(free_columns).with_larger_noise(np.maximum(guess.variance_scale, 1.0))
        more_rows, more_columns = associate_mahalanobis(
            candidates.select(free_rows), noisier, guess.T, guess.covariance, self._T_rig_optical, self._config
        )
        return free_rows[more_rows], free_columns[more_columns]

    def _by_prediction(
        self, candidates: Candidates, frame: Frame, prior: MotionPrior, rng: np.random.Generator
    ) -> FrameLink | None:
        config = self._config
        if _image_spread(prior, frame) > _MAX_GATE_PX:
            return None
        rows, columns = self._associate(candidates, frame, prior)
        guess = guess_motion(
            candidates.places(rows),
            frame.places(columns),
            self._T_rig_optical,
            rng,
            _HYPOTHESES,
            config.gate,
            prior.T,
        )
        if guess is None or guess.inliers.sum() < max(config.min_inliers, 0.5 * len(rows)):
            return None
        return self._refine_matches(candidates, frame, guess, config.min_inliers)

    def _by_guess(
        self,
        candidates: Candidates,
        frame: Frame,
        rng: np.random.Generator,
        is_refuted: Callable[[FrameLink], bool],
    ) -> FrameLink | None:
        """First with the descriptors that agree well, then with all that agree at all."""
        config = self._config
        matches = match_descriptors(candidates.descriptors @ frame.descriptors.T)
        strict = matches.clear(config.descriptor_threshold, _GUESS_RATIO)
        loose = matches.clear(_GUESS_DESCRIPTOR_THRESHOLD, 1.0)
        for rows, columns in (strict, loose):
            guess = guess_motion(
                candidates.places(rows),
                frame.places(columns),
                self._T_rig_optical,
                rng,
                2 * _HYPOTHESES,
                config.gate,
            )
            enough = max(config.min_inliers, _MIN_INLIER_RATIO * len(rows))
            if guess is None or guess.inliers.sum() < enough:
                continue
            link = self._refine_matches(candidates, frame, guess, _GUESS_MIN_INLIERS)
            if link is not None and not is_refuted(link):
                return link
        return None

    def _associate(self, candidates: Candidates, frame: Frame, prior: MotionPrior) -> tuple[IndexArray, IndexArray]:
        config = self._config
        if config.method == "nearest":
            return associate_nearest(candidates, frame, prior.T, self._T_rig_optical, config)
        return _METHODS[config.method](candidates, frame, prior.T, prior.covariance, self._T_rig_optical, config)

    def _refine_matches(self, candidates: Candidates, frame: Frame, guess: MotionGuess, least: int) -> FrameLink | None:
        """Associate once more around the motion found, where the gates are as small as they can be."""
        if self._config.method == "nearest":
            by_distance = candidates, frame, guess.T, self._T_rig_optical, self._config
            link = self._link_of(candidates, frame, guess.T, *associate_nearest(*by_distance), least)
            return None if link is None else replace(link, wrong=wrong_pair_variance(*by_distance))
        noisier = frame.with_larger_noise(np.maximum(guess.variance_scale, 1.0))
        rows, columns = associate_mahalanobis(
            candidates, noisier, guess.T, guess.covariance, self._T_rig_optical, self._config
        )
        return self._link_of(candidates, frame, guess.T, rows, columns, least)

    def _link_of(
        self, candidates: Candidates, frame: Frame, T: FloatArray, rows: IndexArray, columns: IndexArray, least: int
    ) -> FrameLink | None:
        """The motion of pairs, from T, and those that agree with it; None if these are fewer than ``least``."""
        final = refine_motion(candidates.places(rows), frame.places(columns), self._T_rig_optical, T, self._config.gate)
        if final is None or final.inliers.sum() < least or not _is_usable(final):
            return None
        # In the order of the features, not of their errors: to measure the best-fitting first would choose by noise.
        inliers = np.flatnonzero(final.inliers)
        inliers = inliers[np.argsort(columns[inliers], kind="stable")]
        return FrameLink(
            final.T, final.covariance, final.variance_scale, rows[inliers], columns[inliers], final.error[inliers]
        )


def _is_usable(motion: MotionGuess) -> bool:
    """True if a motion is finite and determined in all directions."""
    finite = np.isfinite(motion.T).all() and np.isfinite(motion.covariance).all()
    return bool(finite) and bool(np.linalg.eigvalsh(motion.covariance)[0] > 0.0)


def _number_of_pairs(link: FrameLink) -> int:
    return len(link.rows)


def _image_spread(prior: MotionPrior, frame: Frame) -> float:
    """One sigma (px) by which the prior's motion moves the image of a point at the frame's median distance."""
    halves = np.stack([prior.covariance[:3, :3], prior.covariance[3:, 3:]])
    translation, rotation = np.linalg.eigvalsh(halves)[:, -1]
    return float(frame.camera.fx * np.sqrt(rotation + translation * median(frame.z[:, 2]) ** 2))
