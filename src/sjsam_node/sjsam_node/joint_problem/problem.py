# SPDX-License-Identifier: Apache-2.0
"""Input of joining: local maps, each one Gaussian in the frame of its reference pose, and the state they share."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sjsam_node.joint_problem import kernels
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers


@dataclass(frozen=True, eq=False)
class LocalMap:
    """One Gaussian over poses and landmarks, in the frame of the pose ``reference``.

    poses (k,) and landmarks (n,) are indices into the state; mean (m,) and information (m, m) are ordered poses first
    (position, then angles), landmarks after. The angles of the mean are a planar angle, a rotation vector or Euler
    angles, as the problem's ``model`` says. pull (m,): gradient of half the cost at the mean, zero unless the mean was
    taken elsewhere than at the map's own optimum; with the residual r the map costs ``r^T information r + 2 pull^T r``.
    """

    reference: int
    poses: IntArray
    landmarks: IntArray
    mean: FloatArray
    information: FloatArray
    cost_gradient: FloatArray | None = None


def block_rows(m: LocalMap, pose_size: int, landmark_size: int) -> LocalMap:
    """The map as Algorithm 4 takes it: every pose and landmark with its own covariance, correlations dropped."""
    sizes = [pose_size] * len(m.poses) + [landmark_size] * len(m.landmarks)
    covariance = np.linalg.inv(m.information)
    information = np.zeros_like(covariance)
    start = 0
    for size in sizes:
        block = slice(start, start + size)
        information[block, block] = np.linalg.inv(covariance[block, block])
        start += size
    return LocalMap(m.reference, m.poses, m.landmarks, m.mean, information)


class FlatMaps(NamedTuple):
    """Local maps one after the other, as the compiled kernels read them."""

    reference: IntArray
    pose_ptr: IntArray
    poses: IntArray
    landmark_ptr: IntArray
    landmarks: IntArray
    mean_ptr: IntArray
    mean: FloatArray
    information_ptr: IntArray
    information: FloatArray
    cost_gradient: FloatArray

    def first(self, count: int) -> FlatMaps:
        """The first ``count`` local maps, without copying the values."""
        return FlatMaps(
            self.reference[:count], self.pose_ptr[: count + 1], self.poses, self.landmark_ptr[: count + 1],
            self.landmarks, self.mean_ptr[: count + 1], self.mean, self.information_ptr[: count + 1],
            self.information, self.cost_gradient,
        )  # fmt: skip

    def unflattened(self) -> list[LocalMap]:
        """The local maps one by one."""
        ptrs = self.pose_ptr, self.landmark_ptr, self.mean_ptr, self.information_ptr, self.mean_ptr
        values = self.poses, self.landmarks, self.mean, self.information, self.cost_gradient
        parts = [split(v, p) for p, v in zip(ptrs, values, strict=True)]
        return [
            LocalMap(int(reference), poses, landmarks, mean, information.reshape(len(mean), -1), cost_gradient)
            for reference, poses, landmarks, mean, information, cost_gradient in zip(
                self.reference, *parts, strict=True
            )
        ]


def flatten(maps: Sequence[LocalMap]) -> FlatMaps:
    """Local maps as :class:`FlatMaps`."""
    return FlatMaps(
        np.array([m.reference for m in maps], dtype=np.int64),
        pointers([len(m.poses) for m in maps]),
        _joined([m.poses for m in maps], np.int64),
        pointers([len(m.landmarks) for m in maps]),
        _joined([m.landmarks for m in maps], np.int64),
        pointers([len(m.mean) for m in maps]),
        _joined([m.mean for m in maps], np.float64),
        pointers([m.information.size for m in maps]),
        _joined([m.information.ravel() for m in maps], np.float64),
        _joined([np.zeros(len(m.mean)) if m.cost_gradient is None else m.cost_gradient for m in maps], np.float64),
    )


def _joined(parts: Sequence[Any], dtype: type) -> Any:
    return np.concatenate([np.asarray(p, dtype=dtype).ravel() for p in parts]) if parts else np.empty(0, dtype)


def split(values: npt.NDArray[Any], ptr: IntArray) -> list[npt.NDArray[Any]]:
    """Stretches of an array, as views; ``ptr`` (n + 1,) says where they start."""
    ends = ptr.tolist()
    return [values[a:b] for a, b in itertools.pairwise(ends)]


@dataclass(frozen=True, eq=False)
class JoiningState:
    """Poses as rotations (P, d, d) and translations (P, d), landmarks (L, d), d = 2 or 3, all in the map frame."""

    rotations: FloatArray
    translations: FloatArray
    landmarks: FloatArray

    @property
    def model_dimensions(self) -> tuple[int, int]:
        """Dimensions of a pose (3 or 6) and of a landmark (2 or 3)."""
        return (3, 2) if self.translations.shape[1] == 2 else (6, 3)

    def retract(self, pose_offset: IntArray, landmark_offset: IntArray, step: FloatArray) -> JoiningState:
        """The state moved by ``step``, variables found at the given offsets (-1 stays)."""
        out = JoiningState(
            np.empty_like(self.rotations), np.empty_like(self.translations), np.empty_like(self.landmarks)
        )
        kernels.retract(
            self.rotations, self.translations, self.landmarks, pose_offset, landmark_offset, step,
            out.rotations, out.translations, out.landmarks,
        )  # fmt: skip
        return out
