# SPDX-License-Identifier: Apache-2.0
"""Number of false alarms of an alignment: how often chance would make as many pairs of landmarks agree with one.

An a-contrario model (Desolneux, Moisan and Morel 2000; of rigid motions Moisan and Stival 2004, Eq. 6). Were the two
submaps of different places, a pair that descriptors have made would tie a landmark of the second to any one of the
first. The chance that it agrees with an alignment is then the share of the first submap's landmarks that lie inside
its gate, which is counted. Any three of the ``n`` pairs make an alignment, and each of the others meets it or not:

    NFA = C(n, 3) P(B(n - 3, p) >= k - 3)

with the mean ``p`` of the chances, which bounds the tail of unlike ones (Hoeffding 1956). Pairs that the gate cannot
tell from each other are one thing seen several times and count once, so that many features in one spot say little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, gammaln

from sjsam_node.graph.links import Prior
from sjsam_node.graph.map_graph import BoolArray
from sjsam_node.loop_closure.association import (
    GATE_PROBABILITY,
    MAX_VARIANCE_FACTOR,
    Alignment,
    AssociationConfig,
    PointSet,
    nis_one_by_one,
    variance_factor,
    variances_seen,
)
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray

_SAMPLE = 3
"""Pairs that determine a rigid alignment."""
_LEAST = 1e-300
"""Smallest probability that is told from zero."""


@dataclass(frozen=True)
class ClosureEvidence:
    """Pairs made by descriptors alone, those of them that agree with one alignment, and their mean chance to do so."""

    pairs: int
    agreeing: int
    chance: float

    @property
    def log10_false_alarms(self) -> float:
        """log10 of the number of alignments as good as this one that chance would make of the pairs."""
        n, k = self.pairs, self.agreeing
        if k <= _SAMPLE:
            return float(np.log10(max(_choices(n), 1.0)))
        tail = betainc(k - _SAMPLE, n - k + 1, min(self.chance, 1.0))  # P(B(n - 3, p) >= k - 3)
        return float(np.log10(_choices(n)) + np.log10(max(tail, _LEAST)))


def _choices(n: int) -> float:
    return float(np.exp(gammaln(n + 1) - gammaln(_SAMPLE + 1) - gammaln(n - _SAMPLE + 1))) if n >= _SAMPLE else 0.0


def evidence_of(
    first: PointSet, second: PointSet, pairs: IntArray, found: Alignment, config: AssociationConfig
) -> ClosureEvidence:
    """Evidence of ``pairs`` (n, 2), made by descriptors alone, for an alignment of two submaps.

    The gates are as wide as the errors of the alignment's own matches say that the submaps are too sure of themselves.
    """
    if not len(pairs) or not len(found.pairs):
        return ClosureEvidence(len(pairs), 0, 1.0)
    alignment = Prior(found.T, found.covariance)
    own = variance_factor(nis_one_by_one(first, second, found.pairs, alignment, config))
    bound = min(own, MAX_VARIANCE_FACTOR) * chi_square_bound(GATE_PROBABILITY, 3)
    S = (
        first.variances()[None]
        + config.position_noise**2 * np.eye(3)
        + variances_seen(second, alignment)[pairs[:, 1], None]
    )
    seen = transform_points(found.T, second.points[pairs[:, 1]])
    gap = first.points[None] - seen[:, None]
    is_inside = np.einsum("nmi,nmi->nm", gap, np.linalg.solve(S, gap[..., None])[..., 0]) <= bound
    agrees = is_inside[np.arange(len(pairs)), pairs[:, 0]]
    chance = np.maximum(is_inside.sum(axis=1), 1) / len(first.points)
    kept = _apart(pairs[:, 0], is_inside, agrees)
    return ClosureEvidence(len(kept), int(agrees[kept].sum()), float(chance[kept].mean()))


def _apart(partner: IntArray, is_inside: BoolArray, agrees: BoolArray) -> IntArray:
    """Indices of pairs, agreeing ones first, none of whose partners lies inside the gate of one before it."""
    kept: list[int] = []
    for k in np.argsort(~agrees, kind="stable").tolist():
        if not is_inside[kept, partner[k]].any():
            kept.append(k)
    return np.array(kept, dtype=np.int64)
