# SPDX-License-Identifier: Apache-2.0
"""Poses of a path as version 3 of a submap for the air has them: each with a factor on the end pose's covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray
from slam_radio.packing.byte_reader import ByteReader
from slam_radio.packing.key_poses import AT_START, KeyPoses, covering, pose_of

_AT_END = 1.0 + 2.0 * float(np.finfo(np.float16).eps)
"""Factor of a pose that is the end: 1, rounded up."""


@dataclass(frozen=True, eq=False)
class EarlierPoses:
    """Poses of a path.

    Attributes
    ----------
    begins, ends
        True if the submap's start or end is among them, of which stamp and pose are not sent again.
    inner
        Of the others stamp and T_start_rig.
    factors
        Of all, the factors by which the end pose's covariance covers theirs.
    """

    begins: bool
    ends: bool
    inner: list[tuple[int, FloatArray]]
    factors: FloatArray

    @classmethod
    def read(cls, reader: ByteReader, count: int, *, begins: bool, ends: bool) -> EarlierPoses:
        """The poses of a message; ``ValueError`` for what cannot be."""
        inner = [(reader.number("<q"), pose_of(reader.floats("<f4", (6,)))) for _ in range(count)]
        factors = reader.floats("<f2", (count + begins + ends,))
        if (factors < 0.0).any():
            raise ValueError("a submap for the air has a pose without uncertainty")
        return cls(begins, ends, inner, factors)

    def key_poses(self, start_ns: int, end_ns: int, end: FloatArray, covariance: FloatArray) -> KeyPoses:
        """The poses as they are kept now, none of them surer; ``ValueError`` if one is too uncertain for that.

        Stamps, end pose and covariance (6, 6) of the end pose are those of the submap.
        """
        entries = [
            *([(start_ns, np.eye(4))] if self.begins else []),
            *self.inner,
            *([(end_ns, end)] if self.ends else []),
        ]
        begins = self.begins and bool(self.factors[0] <= AT_START)
        ends = self.ends and bool(self.factors[-1] <= _AT_END)
        inner = [
            (stamp, T, covering(max(factor, AT_START) * covariance))
            for (stamp, T), factor in zip(entries, self.factors, strict=True)
        ]
        return KeyPoses(begins, ends, inner[int(begins) : len(inner) - int(ends)])
