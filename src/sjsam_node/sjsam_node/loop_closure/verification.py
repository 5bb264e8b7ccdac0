# SPDX-License-Identifier: Apache-2.0
"""Compares two submaps.

More landmarks, spread in space, must agree on one rigid alignment within both submaps' joint covariance than chance
would make agree (:mod:`sjsam_node.loop_closure.evidence`), and that must agree with what the map already knows of the
two poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.links import Prior, Status
from sjsam_node.loop_closure.association import (  # fmt: skip
    MAX_VARIANCE_FACTOR,
    Alignment,
    AssociationConfig,
    PointSet,
    jointly_compatible,
    match,
    mutual_best,
    similarity,
)
from sjsam_node.loop_closure.evidence import evidence_of
from sjsam_node.loop_closure.place_recognition import PlaceRecognitionConfig
from slam_core.config import Config, group, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.rigid_alignment import ransac_rigid_transform
from slam_core.geometry import FloatArray, boxminus
from slam_core.linear_algebra.sparse_cholesky import IntArray

NEAR_DISTANCE = 3.0
"""Distance between the middles of submaps that are tried as near (m)."""
NEAR_CANDIDATES = 3
"""Near submaps tried per new one."""
LEAST_NEWS_SHARE = 0.1
"""Share of a submap's landmarks that a near one must tell of for the next to be tried."""
ALIKE_CANDIDATES = 2
"""Submaps that look alike tried per new one."""
INFORMATIVE_SIGMA = 0.5
"""Largest standard deviation of a relative position that can tell two places apart (m)."""
_MAX_ANGLE_RATIO = 0.9
"""Second best to best angle of descriptors, where no prior helps."""
_MIN_ALIKE_SIMILARITY = 0.7
"""Least scalar product of descriptors, where no prior helps."""
RANSAC_DISTANCE = 0.15
"""Largest distance of an inlier of the first alignment (m)."""
MIN_NEAR_INLIERS = 5
"""Least matches of a link to a near submap."""
_MIN_ALIKE_PAIRS = 5
"""Least pairs by descriptors alone that agree, for a submap found by its looks to be compared."""
MAX_FALSE_ALARMS = 1e-6
"""Closures like one found by its looks that chance makes in a comparison, at most, for it to be believed."""
_MIN_SPREAD = 0.25
"""Least second-largest standard deviation of the matched landmarks (m)."""
_MIN_OVERLAP = 0.3
"""Least share of the landmarks expected in both that match."""
LINKED_SUBMAPS = 3
"""Submaps back along the agent's path that a new one is linked to directly."""
MAX_PENDING_LINKS = 20
"""Links that wait for others to close a cycle with, at most."""
CLOSURE_PROBABILITY = 0.9999
"""Share of true closures inside the chi-square gate."""


@dataclass(frozen=True)
class ClosureConfig(Config):
    """Conditions on a link between submaps for it to be believed."""

    drift: float = parameter(
        0.01, "drift of odometry to expect beyond its covariance, per metre of way, one sigma", unit="m/m", minimum=0.0
    )
    drift_angle: float = parameter(0.003, "the same for rotation", unit="rad/m", minimum=0.0)
    seed: int = parameter(1, "seed of the random samples", minimum=0)
    association: AssociationConfig = group(AssociationConfig)
    places: PlaceRecognitionConfig = group(PlaceRecognitionConfig)


@dataclass
class Verifier:
    """Compares two submaps, landmark by landmark.

    ``looks``: alignments by looks alone that were found ahead, by the key that seeds them; others are found when asked.
    """

    config: ClosureConfig = field(default_factory=ClosureConfig)
    looks: Mapping[tuple[int, ...], Alignment | None] = field(default_factory=dict)

    def verify(
        self, first: PointSet, second: PointSet, prior: Prior | None, path_length: float, *key: int
    ) -> tuple[Alignment | None, Status]:
        """The alignment of two submaps if geometry supports it, and what the prior says of it.

        First around the prior, if it is informative, then by looks. ``path_length`` is that of the path between them,
        m: what the prior does not know is at least its drift. ``key`` seeds the random samples, so that the same pair
        always gets the same verdict.
        """
        found = self.verify_near(first, second, prior)
        return (
            (found, Status.CONSISTENT)
            if found is not None
            else self.verify_alike(first, second, prior, path_length, *key)
        )

    def verify_near(self, first: PointSet, second: PointSet, prior: Prior | None) -> Alignment | None:
        """The alignment of two submaps around a prior.

        None where it is not informative, or geometry does not support it.
        """
        if prior is None or largest_sigma(prior.covariance) >= INFORMATIVE_SIGMA:
            return None
        found = self._around(first, second, prior)
        enough = len(found.pairs) >= MIN_NEAR_INLIERS and self._overlaps(first, second, found)
        return found if enough else None

    def verify_alike(
        self, first: PointSet, second: PointSet, prior: Prior | None, path_length: float, *key: int
    ) -> tuple[Alignment | None, Status]:
        """The alignment of two submaps by their looks, if geometry supports it, and what the prior says of it."""
        guess = self.looks[key] if key in self.looks else self.by_looks(first, second, key)
        if guess is None or not self._is_supported(first, second, guess):
            return None, Status.UNINFORMATIVE
        if prior is None or not self.is_against(guess, prior, path_length):
            return guess, Status.UNINFORMATIVE
        return guess if self.is_evident(first, second, guess) else None, Status.INCONSISTENT

    def _around(self, first: PointSet, second: PointSet, prior: Prior) -> Alignment:
        """Match around a prior, then around what that found.

        A map too sure of itself admits only matches that agree with its error; further ones show where they lead.
        """
        assert prior.covariance is not None
        found = match(first, second, prior, self.config.association)
        if len(found.pairs) < 3:
            return found
        loose = MAX_VARIANCE_FACTOR * prior.covariance
        more = match(first, second, Prior(found.T, loose), self.config.association)
        return more if len(more.pairs) > len(found.pairs) else found

    def by_looks(self, first: PointSet, second: PointSet, key: tuple[int, ...]) -> Alignment | None:
        """Alignment from descriptors alone, refined with all landmarks around it; ``key`` seeds the random samples."""
        pairs = self._distinct_pairs(first, second)
        if len(pairs) < _MIN_ALIKE_PAIRS:
            return None
        rng = np.random.default_rng([self.config.seed, *key])
        coarse = ransac_rigid_transform(
            second.points[pairs[:, 1]], first.points[pairs[:, 0]], RANSAC_DISTANCE, rng,
            min_inliers=_MIN_ALIKE_PAIRS,
        )  # fmt: skip
        if not coarse.success:
            return None
        loose = np.diag([RANSAC_DISTANCE**2] * 3 + [0.05**2] * 3)
        found = match(first, second, Prior(coarse.T, loose), self.config.association)
        # The guess came from the same landmarks: without its weight the covariance is that of the landmarks alone.
        free = Prior(found.T, 1e4 * np.eye(6))
        return jointly_compatible(first, second, found.pairs, free, self.config.association)

    def is_alike(self, first: PointSet, second: PointSet) -> bool:
        """True if descriptors alone leave a chance; asked before anything dearer."""
        return len(self._distinct_pairs(first, second)) >= _MIN_ALIKE_PAIRS

    def _distinct_pairs(self, first: PointSet, second: PointSet) -> IntArray:
        """Mutually best descriptor pairs, clearly better than the second best."""
        S = similarity(first, second)
        if min(S.shape) < 2:
            return np.empty((0, 2), dtype=np.int64)
        i, j = np.nonzero(_MIN_ALIKE_SIMILARITY <= S)
        pairs = mutual_best(i, j, -S[i, j].astype(np.float64))
        angle = np.arccos(np.clip(np.partition(S[pairs[:, 0]], -2, axis=1)[:, -2:], -1.0, 1.0))
        return pairs[angle[:, 1] <= _MAX_ANGLE_RATIO * angle[:, 0]]

    def is_evident(self, first: PointSet, second: PointSet, found: Alignment) -> bool:
        """True if an alignment by looks needs nothing else that speaks for it."""
        return self.log10_false_alarms(first, second, found) <= float(np.log10(MAX_FALSE_ALARMS))

    def log10_false_alarms(self, first: PointSet, second: PointSet, found: Alignment) -> float:
        """log10 of how many alignments as good as this one chance would make of the descriptors' distinct pairs."""
        pairs = self._distinct_pairs(first, second)
        return evidence_of(first, second, pairs, found, self.config.association).log10_false_alarms

    def _is_supported(self, first: PointSet, second: PointSet, found: Alignment) -> bool:
        """Fewer than one false alarm to expect of this comparison, and matches as spread and many as the overlap."""
        enough = len(found.pairs) >= MIN_NEAR_INLIERS and self._overlaps(first, second, found)
        return enough and self.log10_false_alarms(first, second, found) < 0.0

    def _overlaps(self, first: PointSet, second: PointSet, found: Alignment) -> bool:
        """Matches are spread, and most landmarks that lie among them on both sides are matched."""
        matched = first.points[found.pairs[:, 0]]
        if np.sqrt(max(np.linalg.eigvalsh(np.cov(matched.T))[1], 0.0)) < _MIN_SPREAD:
            return False
        low, high = matched.min(axis=0), matched.max(axis=0)
        moved = second.points @ found.T[:3, :3].T + found.T[:3, 3]
        expected = min(_inside(first.points, low, high), _inside(moved, low, high))
        return len(matched) >= _MIN_OVERLAP * expected

    def is_against(self, found: Alignment, prior: Prior, path_length: float) -> bool:
        """True if an alignment contradicts the prior, which has drifted along ``path_length`` m."""
        return self.error_against(found, prior, path_length) > chi_square_bound(CLOSURE_PROBABILITY, 6)

    def error_against(self, found: Alignment, prior: Prior, path_length: float) -> float:
        """Normalised squared error of an alignment against the prior, which has drifted along ``path_length`` m."""
        assert prior.covariance is not None
        error = boxminus(found.T, prior.T)
        return float(error @ np.linalg.solve(prior.covariance + found.covariance + self.drift(path_length), error))

    def drift(self, path_length: float) -> FloatArray:
        """Covariance (6, 6) of the drift to expect on a ``path_length`` (m) beyond what the odometry claims."""
        return np.diag(
            [(self.config.drift * path_length) ** 2] * 3 + [(self.config.drift_angle * path_length) ** 2] * 3
        )


def largest_sigma(covariance: FloatArray | None) -> float:
    """Largest standard deviation of a position, m."""
    return 0.0 if covariance is None else float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _inside(points: FloatArray, low: FloatArray, high: FloatArray) -> int:
    return int(np.all((points >= low) & (points <= high), axis=1).sum())
