# SPDX-License-Identifier: Apache-2.0
"""Landmarks as they are sent: positions on a grid, factors of their covariances, common directions, looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_radio.packing.symbol_code import IntArray, SymbolReader, SymbolWriter

MOST_LANDMARKS, MOST_RANK, MOST_WIDTH = 400, 64, 1024
FINEST, COARSEST = -20, 0
"""Powers of two m of the grid."""
_MOST_CELLS = 2**28
_SHARE = 0.25
"""Largest error of a position over the least standard deviation that nine of ten landmarks have."""
_MOST_SIGHTINGS = 255


@dataclass(frozen=True, eq=False)
class LandmarkBlock:
    """n landmarks with r common directions and c numbers a descriptor.

    Attributes
    ----------
    exponent
        Power of two of the grid's step, m.
    cells
        Positions (n, 3) in steps.
    factors
        See :class:`slam_radio.packing.compact_gaussian.CompactGaussian`, (n, 6).
    common
        Rows of U in 64ths, (3n, r).
    ids, sightings
        Ascending ids, and sightings up to 255, (n,).
    codes
        See :mod:`slam_radio.packing.descriptor_code`, (n, c).
    """

    exponent: int
    cells: IntArray
    factors: IntArray
    common: IntArray
    ids: IntArray
    sightings: IntArray
    codes: IntArray

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def points(self) -> FloatArray:
        """Positions (n, 3), m."""
        return np.ldexp(self.cells.astype(np.float64), self.exponent)

    def write(self, writer: SymbolWriter) -> None:
        """Write the columns, in the order in which :meth:`read` reads them."""
        for column in (*self.cells.T, *self.factors.T, self.ids[:1], np.diff(self.ids), self.sightings):
            writer.column(column)
        writer.columns(self.common)
        writer.columns(self.codes)

    @classmethod
    def read(
        cls, reader: SymbolReader, exponent: int, n: int, rank: int, width: int, *, has_ids_together: bool = False
    ) -> LandmarkBlock:
        """The landmarks of a message.

        ``has_ids_together``: the first id stands in one column with the others, as in messages of an earlier version.

        Raises
        ------
        ValueError
            If there are too many, or they say what cannot be.
        """
        if n > MOST_LANDMARKS or rank > MOST_RANK or width > MOST_WIDTH or not FINEST <= exponent <= COARSEST:
            raise ValueError(f"a submap for the air cannot have {n} landmarks, {rank} directions, {width} numbers")
        columns = [reader.column(n) for _ in range(9)]
        cells, factors = np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)
        counts = (n,) if has_ids_together else (min(n, 1), max(n - 1, 0))
        first, steps = np.split(np.concatenate([reader.column(count) for count in counts]), [1])
        sightings = reader.column(n)
        common, codes = reader.columns(3 * n, rank), reader.columns(n, width)
        if (
            np.abs(cells).max(initial=0) >= _MOST_CELLS
            or (steps <= 0).any()
            or (first < 0).any()
            or not ((sightings >= 0) & (sightings <= _MOST_SIGHTINGS)).all()
        ):
            raise ValueError("a submap for the air holds landmarks that cannot be")
        return cls(exponent, cells, factors, common, np.cumsum(np.concatenate([first, steps])), sightings, codes)


def shown_sightings(sightings: npt.NDArray[np.int32]) -> IntArray:
    """Sightings as they are sent."""
    return np.clip(sightings, 0, _MOST_SIGHTINGS).astype(np.int64)


def grid_exponent(blocks: FloatArray) -> int:
    """Power of two of a grid that is fine enough for landmarks with covariances (n, 3, 3)."""
    if not len(blocks) or not np.isfinite(blocks).all():
        return COARSEST
    least = np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, 0], 1e-16))
    step = 2.0 * _SHARE * float(np.sort(least)[len(least) // 10])
    return int(np.clip(np.floor(np.log2(step)), FINEST, COARSEST))


def on_grid(points: FloatArray, exponent: int) -> IntArray:
    """Positions in steps of a grid; ``ValueError`` for those too far away."""
    cells = np.rint(np.ldexp(points, -exponent))
    if not np.abs(cells).max(initial=0.0) < _MOST_CELLS:
        raise ValueError(f"a landmark at {np.abs(points).max():.3g} m is too far away to be sent")
    return cells.astype(np.int64)


def half_step(exponent: int) -> float:
    """Largest error of a position along an axis of the grid, m."""
    return 0.5 * 2.0**exponent
