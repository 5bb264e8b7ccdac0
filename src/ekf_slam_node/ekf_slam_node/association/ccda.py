# SPDX-License-Identifier: Apache-2.0
"""Combined constraint data association (Bailey 2002, thesis 9.4.1): the largest set of pairs that agree two by two.

Each possible pair of a measurement and a landmark is a node of a graph. Two pairs are linked if both can be true: the
two landmarks are as far apart as the two measurements say. A true association is a set in which every two are linked,
and the largest one is looked for. A distance between landmarks does not depend on where the rig is, so that nothing
need be known of its pose.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ekf_slam_node.association.jcbb import UNPAIRED, IndexArray
from slam_core.geometry import FloatArray

_LEAST_DISTANCE = 1e-9


def ccda(
    rows: IndexArray,
    columns: IndexArray,
    costs: FloatArray,
    fits: npt.NDArray[np.bool_],
    measurements: int,
    *,
    max_nodes: int = 20_000,
) -> IndexArray:
    """Landmark (m,) of each of the ``measurements``, or -1.

    Parameters
    ----------
    rows, columns, costs
        Landmark, measurement and cost (n,) of each possible pair; the search begins with the cheapest.
    fits
        Whether two pairs agree, (n, n), symmetric.
    measurements
        How many there are.
    max_nodes
        Branches looked at before the largest set so far is taken.
    """
    order = np.argsort(costs, kind="stable")
    compatible = fits[np.ix_(order, order)]
    rows, columns = rows[order], columns[order]
    compatible &= (rows[:, None] != rows) & (columns[:, None] != columns)
    chosen = _Search(compatible, max_nodes).largest()
    found = np.full(measurements, UNPAIRED, dtype=np.int64)
    found[columns[chosen]] = rows[chosen]
    return found


def equal_distances(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray], gate: float
) -> npt.NDArray[np.bool_]:
    """True if pairs of points are two by two equally far apart, (n, n).

    Parameters
    ----------
    first, second
        The points of both sides, (n, d) m, and the variances (n, n) m2 of the distances between them.
    gate
        Of the squared difference over its variance, chi-square of 1 degree of freedom.
    """
    (a, variance_a), (b, variance_b) = first, second
    difference = _distances(a)[0] - _distances(b)[0]
    return np.asarray(difference**2 <= gate * (variance_a + variance_b))


def distance_variances(points: FloatArray, covariances: FloatArray) -> FloatArray:
    """Variances (n, n) m2 of the distances between points (n, d).

    Their covariances are (n, d, d) where the points err independently, else (n, d, n, d).
    """
    unit = _distances(points)[1]
    if covariances.ndim == 3:
        own = np.einsum("ijk,ikl,ijl->ij", unit, covariances, unit)
        return np.asarray(own + own.T)
    diagonal = covariances[np.arange(len(points)), :, np.arange(len(points)), :]
    cross = np.einsum("ijk,ikjl,ijl->ij", unit, covariances, unit)
    own = np.einsum("ijk,ikl,ijl->ij", unit, diagonal, unit)
    return np.asarray(np.maximum(own + own.T - cross - cross.T, 0.0))


def _distances(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (n, n) between points (n, d), and unit vectors (n, n, d) along them."""
    offset = points[None] - points[:, None]
    distance = np.linalg.norm(offset, axis=2)
    return distance, offset / np.maximum(distance, _LEAST_DISTANCE)[:, :, None]


class _Search:
    """Maximum clique by branch and bound, bounded by a greedy colouring (Tomita and Seki 2003).

    A set of nodes is the bits of an int.
    """

    def __init__(self, adjacent: npt.NDArray[np.bool_], max_nodes: int) -> None:
        np.fill_diagonal(adjacent, False)
        packed = np.packbits(adjacent, axis=1, bitorder="little")
        self._neighbours = [int.from_bytes(row.tobytes(), "little") for row in packed]
        self._nodes_left = max_nodes
        self._best: list[int] = []

    def largest(self) -> IndexArray:
        """Numbers of the nodes of the largest set found, ascending."""
        self._grow([], (1 << len(self._neighbours)) - 1)
        return np.array(sorted(self._best), dtype=np.int64)

    def _grow(self, chosen: list[int], open_nodes: int) -> None:
        """Extend a set by nodes that fit to all of it."""
        if len(chosen) > len(self._best):
            self._best = chosen
        for node, bound in reversed(self._coloured(open_nodes)):
            if len(chosen) + bound <= len(self._best) or self._nodes_left <= 0:
                return
            self._nodes_left -= 1
            self._grow([*chosen, node], open_nodes & self._neighbours[node])
            open_nodes &= ~(1 << node)

    def _coloured(self, nodes: int) -> list[tuple[int, int]]:
        """Nodes in classes within which none are linked, each with the number of classes up to its own.

        No set among the nodes up to there has more members than that.
        """
        found, colour = [], 0
        while nodes:
            colour += 1
            independent = nodes
            while independent:
                node = independent.bit_length() - 1  # the dearest first: the cheapest are tried first from behind
                found.append((node, colour))
                nodes &= ~(1 << node)
                independent &= ~(1 << node) & ~self._neighbours[node]
        return found
