# SPDX-License-Identifier: Apache-2.0
"""Links between submaps: which of their landmarks are the same, and what the map says of that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from slam_core.geometry import FloatArray, inverse_jacobian, invert_transform
from slam_core.linear_algebra.sparse_cholesky import IntArray


class Status(Enum):
    """Verdict of the map on a link's relative pose: it agrees, it cannot tell, or it disagrees."""

    CONSISTENT = "consistent"
    UNINFORMATIVE = "uninformative"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True, eq=False)
class Link:
    """Matched landmarks of two records: index pairs (k, 2) and the alignment T_first_second they imply.

    covariance: (6, 6) of T. A loop closure (``is_closure``) in the graph is consistent; one that is not waits: for
    another that says the same (uninformative), or until more speaks for it than against it (inconsistent). error:
    squared error of the alignment against what the map knew, normalised by the map's covariance.
    """

    first: int
    second: int
    pairs: IntArray
    T: FloatArray
    covariance: FloatArray
    is_closure: bool = False
    error: float = 0.0
    status: Status = Status.CONSISTENT

    @property
    def ends(self) -> tuple[int, int]:
        """The two records."""
        return self.first, self.second

    def inverted(self) -> Link:
        """Link from the second record to the first."""
        T = invert_transform(self.T)
        J = inverse_jacobian(self.T)
        covariance = J @ self.covariance @ J.T
        return replace(
            self, first=self.second, second=self.first, pairs=self.pairs[:, ::-1], T=T, covariance=covariance
        )

    def with_status(self, status: Status) -> Link:
        """Link with another status."""
        return replace(self, status=status)


@dataclass(frozen=True, eq=False)
class Prior:
    """Knowledge beforehand of ``T`` = T_first_second: covariance (6, 6); None if ``T`` is exact."""

    T: FloatArray
    covariance: FloatArray | None
