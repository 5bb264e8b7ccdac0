# SPDX-License-Identifier: Apache-2.0
"""A few poses of a submap's path, each with standard deviations that cover its covariance in every direction."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray, boxminus, boxplus, is_rigid_transform
from slam_core.types import PoseEstimate, Submap
from slam_radio.packing.byte_reader import ByteReader

Sigmas = npt.NDArray[np.float16]
_UNIT = 1e-3
"""Standard deviations are sent in mm and mrad."""
AT_START = 1e-6
"""Covariance of the start, which is exact, over that of the end: keeps it positive definite."""
_LEAST_SIGMA = 1e-8


@dataclass(frozen=True, eq=False)
class KeyPoses:
    """Poses of a path.

    Attributes
    ----------
    begins, ends
        Whether the start and the end of the submap are among them, of which nothing is sent again.
    inner
        Of the others stamp, T_start_rig, and standard deviations (6,) in mm and mrad.
    """

    begins: bool
    ends: bool
    inner: list[tuple[int, FloatArray, Sigmas]]

    @classmethod
    def of(cls, submap: Submap, end_pose: FloatArray, end_covariance: FloatArray, most: int) -> KeyPoses:
        """Some poses of a submap's path, spread over its time; both its ends are among them.

        Raises
        ------
        ValueError
            If a pose is too uncertain to be sent.
        """
        path = submap.path
        if len(path) > most:
            path = tuple(path[i] for i in np.unique(np.linspace(0, len(path) - 1, most).round().astype(np.int64)))
        start = PoseEstimate(submap.start_stamp_ns, np.eye(4), AT_START * end_covariance)
        end = PoseEstimate(submap.end_stamp_ns, end_pose, end_covariance)
        begins = bool(path) and _says(start, path[0])
        ends = len(path) > begins and _says(end, path[-1])
        inner = path[int(begins) : len(path) - int(ends)]
        return cls(begins, ends, [(p.stamp_ns, p.T, covering(p.covariance)) for p in inner])

    @classmethod
    def read(cls, reader: ByteReader, count: int, *, begins: bool, ends: bool) -> KeyPoses:
        """The poses of a message; ``ValueError`` for what cannot be."""
        inner = []
        for _ in range(count):
            (stamp,), T = reader.numbers("<q"), pose_of(reader.floats("<f4", (6,)))
            sigmas = reader.floats("<f2", (6,))
            if not (sigmas > 0.0).all():
                raise ValueError("a submap for the air has a pose without uncertainty")
            inner.append((stamp, T, sigmas.astype(np.float16)))
        return cls(begins, ends, inner)

    def bytes(self) -> bytes:
        """The bytes that :meth:`read` takes."""
        return b"".join(
            struct.pack("<q", stamp) + tangent_of(T).tobytes() + sigmas.astype("<f2").tobytes()
            for stamp, T, sigmas in self.inner
        )

    def estimates(
        self, start_ns: int, end_ns: int, end: FloatArray, covariance: FloatArray
    ) -> tuple[PoseEstimate, ...]:
        """The poses with covariances, of a submap with these stamps, end pose and covariance of the end pose."""
        first = [PoseEstimate(start_ns, np.eye(4), AT_START * covariance)] if self.begins else []
        last = [PoseEstimate(end_ns, end, covariance)] if self.ends else []
        inner = [
            PoseEstimate(stamp, T, np.diag((_UNIT * sigmas.astype(np.float64)) ** 2)) for stamp, T, sigmas in self.inner
        ]
        return (*first, *inner, *last)


def tangent_of(T: FloatArray) -> npt.NDArray[np.float32]:
    """A pose as it is sent, (6,)."""
    return np.asarray(boxminus(T, np.eye(4)), dtype="<f4")


def pose_of(tangent: FloatArray) -> FloatArray:
    """Inverse of :func:`tangent_of`; ``ValueError`` for what is no pose."""
    T = boxplus(np.eye(4), tangent)
    if not is_rigid_transform(T):
        raise ValueError("a submap for the air has a pose that is none")
    return T


def _says(known: PoseEstimate, pose: PoseEstimate) -> bool:
    """True if a pose is a known one, but for the rounding of what is sent, and not less sure."""
    if pose.stamp_ns != known.stamp_ns or np.abs(pose.T - known.T).max() >= 1e-6:
        return False
    L = np.linalg.inv(np.linalg.cholesky(known.covariance))
    return bool(np.linalg.eigvalsh(L @ pose.covariance @ L.T)[-1] <= 1.0 + 1e-6)


def covering(covariance: FloatArray) -> Sigmas:
    """Standard deviations whose diagonal covariance less another one is positive semidefinite, rounded up."""
    scale = np.sqrt(np.maximum(np.diag(covariance), _LEAST_SIGMA**2))
    share = max(1.0, float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[-1]))
    sigmas = np.sqrt(share) * scale / _UNIT
    if not sigmas.max() < np.finfo(np.float16).max:
        raise ValueError(f"a pose of the path is too uncertain to be sent: {_UNIT * sigmas.max():.3g} m or rad")
    return np.asarray(np.nextafter(sigmas.astype(np.float16), np.float16(np.inf)))
