# SPDX-License-Identifier: Apache-2.0
"""Block-diagonal matrices of one pose and many landmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray
from slam_radio.packing import packing_kernels


class BlockDiagonal(NamedTuple):
    """A block-diagonal matrix: the pose's block (6, 6) and the landmarks' (n, 3, 3)."""

    pose: FloatArray
    landmarks: FloatArray

    @classmethod
    def of(cls, S: FloatArray) -> BlockDiagonal:
        """The blocks of a matrix (6 + 3n, 6 + 3n)."""
        n = (len(S) - 6) // 3
        return cls(S[:6, :6], S[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])

    def cholesky(self) -> BlockDiagonal:
        """Cholesky factors of the blocks."""
        return self.mapped(np.linalg.cholesky)

    def inverse(self) -> BlockDiagonal:
        """Inverses of the blocks."""
        return self.mapped(np.linalg.inv)

    def coarse(self) -> BlockDiagonal:
        """The blocks in single precision."""
        return self.mapped(lambda blocks: blocks.astype(np.float32))

    def scaled(self, factor: float) -> BlockDiagonal:
        """All blocks times a factor."""
        return self.mapped(lambda blocks: factor * blocks)

    def mapped(self, function: Callable[[FloatArray], Any]) -> BlockDiagonal:
        """The blocks that a function makes of stacks of these."""
        return BlockDiagonal(function(self.pose), function(self.landmarks))

    def times(self, M: AnyArray) -> AnyArray:
        """The product with a matrix (6 + 3n, k)."""
        out = np.empty(M.shape, dtype=np.result_type(self.pose, M))
        packing_kernels.times(*self, M, out)
        return out

    def around(self, other: BlockDiagonal) -> BlockDiagonal:
        """A S A' for this matrix A and a symmetric one of the same blocks."""
        return BlockDiagonal(*(symmetric(A @ S @ np.swapaxes(A, -1, -2)) for A, S in zip(self, other, strict=True)))


def symmetric(S: FloatArray) -> FloatArray:
    """The symmetric part of matrices (..., m, m)."""
    return np.asarray(0.5 * (S + np.swapaxes(S, -1, -2)))
