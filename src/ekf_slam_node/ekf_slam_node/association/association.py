# SPDX-License-Identifier: Apache-2.0
"""Association of features with candidates under a known motion (thesis chapter 4).

Gate first: a pair must lie within the chi-square gate of its innovation covariance S and its descriptors must agree.
Among the pairs that pass, the cheapest come first and every feature and candidate is used once, which is Algorithm 2's
"a better one takes over" without its dependence on the order of the features.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from ekf_slam_node.association.ccda import ccda, distance_variances, equal_distances
from ekf_slam_node.association.jcbb import JointPrediction, jcbb
from ekf_slam_node.association.pair_kernels import first_of_both
from ekf_slam_node.config import FeatureAssociationConfig
from ekf_slam_node.filtering.candidates import Candidates, innovation_covariance, predict
from ekf_slam_node.filtering.models import Frame, Observation, observe, rig_points
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, transform_points
from slam_core.runtime.in_place import in_place

_JOINT_FEATURES = 20
"""Features that the search for joint compatibility takes in."""

IndexArray = npt.NDArray[np.int64]
Similarity = npt.NDArray[np.floating]
_JOINT_CONFIDENCE = 0.999
"""Of the tests that take pairs together."""


@njit(cache=True, nogil=True)
def _gated_pairs(z, variance, looks, seen_z, S, visible, known_looks, threshold, gate, weight):  # type: ignore[no-untyped-def]
    """Rows, columns and costs (Eq. 4.8 plus the descriptors') of all pairs inside the gate, row by row.

    ``looks`` and ``known_looks`` are the features' and the candidates' descriptors, unit norm. Few pairs come as far as
    to have theirs multiplied.
    """
    rows, columns, costs = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.int64), np.empty(_ROOM)
    u, v, variance_u, variance_v = z[:, 0].copy(), z[:, 1].copy(), variance[:, 0].copy(), variance[:, 1].copy()
    near = np.zeros(-(-len(z) // 8) * 8, np.uint8)
    eights = near.view(np.uint64)
    used = 0
    for i in range(len(seen_z)):
        if not visible[i]:
            continue
        if used + len(z) > len(rows):
            rows, columns, costs = _doubled(rows, len(z)), _doubled(columns, len(z)), _doubled(costs, len(z))
        _mark_near(u, v, variance_u, variance_v, seen_z[i], S[i], gate, near)
        for eight in range(len(eights)):
            if eights[eight] == 0:
                continue
            for j in range(8 * eight, min(8 * eight + 8, len(z))):
                if not near[j]:
                    continue
                nis, root = _distance(z[j], variance[j], seen_z[i], S[i])
                if not nis < gate:
                    continue
                similarity = _dot(known_looks[i], looks[j])
                if similarity < threshold:
                    continue
                rows[used], columns[used] = i, j
                costs[used] = nis + 2.0 * np.log(root) + weight * (1.0 - similarity)
                used += 1
    return rows[:used], columns[:used], costs[:used]


@in_place()
def _mark_near(u, v, variance_u, variance_v, seen, S, gate, near):  # type: ignore[no-untyped-def]
    """Mark the features that either pixel coordinate alone does not put outside the gate."""
    for j in range(len(u)):
        du, dv = u[j] - seen[0], v[j] - seen[1]
        near[j] = (du * du < gate * (S[0, 0] + variance_u[j])) & (dv * dv < gate * (S[1, 1] + variance_v[j]))


@in_place()
def _distance(z, variance, seen, S):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis distance of a pair, and the root of the determinant of S + R."""
    du, dv, dw = z[0] - seen[0], z[1] - seen[1], z[2] - seen[2]
    # Cholesky factor of the 3x3 S + R, by hand: this runs for every pair that is near.
    a = np.sqrt(S[0, 0] + variance[0])
    b = S[1, 0] / a
    c = np.sqrt(S[1, 1] + variance[1] - b * b)
    d = S[2, 0] / a
    e = (S[2, 1] - d * b) / c
    f = np.sqrt(max(S[2, 2] + variance[2] - d * d - e * e, 1e-300))
    y0 = du / a
    y1 = (dv - b * y0) / c
    y2 = (dw - d * y0 - e * y1) / f
    return y0 * y0 + y1 * y1 + y2 * y2, a * c * f


@in_place(fastmath={"reassoc", "contract"})
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(len(a)):
        total += np.float64(a[k]) * np.float64(b[k])
    return total


_ROOM = 4096
"""Pairs for which there is room at first."""


@njit(cache=True, nogil=True)
def _doubled(values, more):  # type: ignore[no-untyped-def]
    """Copy of the values with twice the room, and ``more``."""
    out = np.empty(2 * len(values) + more, values.dtype)
    out[: len(values)] = values
    return out


def pair_up(
    rows: IndexArray, columns: IndexArray, costs: FloatArray, shape: tuple[int, ...]
) -> tuple[IndexArray, IndexArray]:
    """Rows and columns of the pairs (n,) taken in the order of their costs, each row and column once.

    ``shape`` says how many rows and columns there are.
    """
    order = np.argsort(costs, kind="stable")
    picked = order[first_of_both(rows[order], columns[order], *shape)]
    return rows[picked], columns[picked]


def associate_mahalanobis(
    candidates: Candidates, frame: Frame, T_previous_now: FloatArray, motion_covariance: FloatArray,
    T_rig_optical: FloatArray, config: FeatureAssociationConfig,
) -> tuple[IndexArray, IndexArray]:  # fmt: skip
    """Algorithm 2: indices of candidates and of features, paired by normalised distance and descriptors.

    Of several cameras each looks for the candidates in its own image; the cheapest of all pairs come first.
    """
    found = []
    for index, camera, T in frame.parts(T_rig_optical):
        seen = observe(T_previous_now, T, candidates.points, camera)
        S = innovation_covariance(seen, candidates, motion_covariance)
        visible = seen.in_image(camera, margin_px=-50.0)
        rows, own, costs = _gated_pairs(
            frame.z[index], frame.variance[index], frame.descriptors[index], seen.z, S, visible, candidates.descriptors,
            config.descriptor_threshold, config.gate, config.descriptor_weight,
        )  # fmt: skip
        found.append((rows, own if isinstance(index, slice) else index[own], costs))
    rows, columns, costs = found[0] if len(found) == 1 else (np.concatenate(part) for part in zip(*found, strict=True))
    return pair_up(rows, columns, costs, (len(candidates), len(frame)))


def same_tracks(
    tracks: npt.NDArray[np.integer], frame_tracks: npt.NDArray[np.integer]
) -> tuple[IndexArray, IndexArray]:
    """Rows and columns of equal tracks, 0 being none, in the order of the columns."""
    if not frame_tracks.any():  # a front end that does not follow
        return np.empty(0, np.intp), np.empty(0, np.intp)
    _, rows, columns = np.intersect1d(tracks, frame_tracks, return_indices=True)
    named = tracks[rows] > 0
    order = np.argsort(columns[named], kind="stable")
    return rows[named][order], columns[named][order]


def associate_nearest(
    candidates: Candidates,
    frame: Frame,
    T_previous_now: FloatArray,
    T_rig_optical: FloatArray,
    config: FeatureAssociationConfig,
) -> tuple[IndexArray, IndexArray]:
    """Algorithm 1: the nearest in space within g_A, noise and descriptors left aside.

    A feature within g_R of a landmark pairs with no candidate that would become a new one.
    """
    distance = _distances(candidates, frame, T_previous_now, T_rig_optical)
    possible = distance < config.nearest_associate
    known = candidates.landmarks
    possible[known:] &= (distance[:known] >= config.nearest_new).all(axis=0)
    rows, columns = np.nonzero(possible)
    return pair_up(rows, columns, distance[rows, columns], distance.shape)


def wrong_pair_variance(
    candidates: Candidates,
    frame: Frame,
    T_previous_now: FloatArray,
    T_rig_optical: FloatArray,
    config: FeatureAssociationConfig,
) -> FloatArray:
    """Variance (n, 3) of u, v and inverse depth that nearest neighbours need beside the features' own.

    Of k candidates within g_A of a feature one is the right one and none is told from the others: a share 1 - 1/k of
    its pairs is wrong, by a point anywhere in the ball, whose variance is g_A^2 / 5 along each axis.
    """
    within = (_distances(candidates, frame, T_previous_now, T_rig_optical) < config.nearest_associate).sum(axis=0)
    wrong = 1.0 - 1.0 / np.maximum(within, 1)
    inverse = frame.z[:, 2]
    scale = np.column_stack([frame.camera.fx * inverse, frame.camera.fy * inverse, inverse**2])
    return np.asarray((wrong * config.nearest_associate**2 / 5.0)[:, None] * scale**2)


def _distances(
    candidates: Candidates, frame: Frame, T_previous_now: FloatArray, T_rig_optical: FloatArray
) -> FloatArray:
    """Distances (m, n) in space of candidates and features, m."""
    moved = transform_points(T_previous_now, rig_points(frame, T_rig_optical)[0])
    return np.asarray(np.linalg.norm(candidates.points[:, None] - moved[None], axis=2))


@dataclass(frozen=True, eq=False)
class DescriptorMatches:
    """Mutual best pairs (k,) of candidates ``rows`` and features ``columns``, without any motion.

    value: (k,) cosine of their descriptors; second: (k,) that of the candidate's second best feature.
    """

    rows: IndexArray
    columns: IndexArray
    value: FloatArray
    second: FloatArray

    def clear(self, threshold: float, ratio: float) -> tuple[IndexArray, IndexArray]:
        """Rows and columns of the pairs better than ``threshold`` and clearly better than the second best."""
        # Distances of unit vectors: |a - b|^2 = 2 - 2 cos.
        kept = (self.value >= threshold) & ((1.0 - self.value) <= ratio**2 * (1.0 - self.second))
        return self.rows[kept], self.columns[kept]


def match_descriptors(similarity: Similarity) -> DescriptorMatches:
    """The mutual best pairs by cosines (m, n) of candidates and features; none of fewer than two of either."""
    m, n = similarity.shape
    best, value, second, row_of = np.zeros(m, np.int64), np.empty(m), np.empty(m), np.zeros(n, np.int64)
    if min(m, n) >= 2:
        _best_two(similarity, best, value, second, row_of)
    rows = np.flatnonzero(row_of[best] == np.arange(m)) if min(m, n) >= 2 else best[:0]
    return DescriptorMatches(rows, best[rows], value[rows], second[rows])


@njit(cache=True, nogil=True)
def _best_two(similarity, best, value, second, row_of):  # type: ignore[no-untyped-def]
    """Fill for each row its best column, that value and the second best one, for each column its best row.

    Of equal values the first counts as the better one.
    """
    m, n = similarity.shape
    highest = np.full(n, -np.inf, similarity.dtype)
    for i in range(m):
        first, other, at = -np.inf, -np.inf, 0
        for j in range(n):
            cosine = similarity[i, j]
            if cosine > other:
                if cosine > first:
                    first, other, at = cosine, first, j
                else:
                    other = cosine
            if cosine > highest[j]:
                highest[j], row_of[j] = cosine, i
        best[i], value[i], second[i] = at, first, other


def associate_jcbb(
    candidates: Candidates, frame: Frame, T_previous_now: FloatArray, motion_covariance: FloatArray,
    T_rig_optical: FloatArray, config: FeatureAssociationConfig,
) -> tuple[IndexArray, IndexArray]:  # fmt: skip
    """Pairs that are jointly compatible: the features with the fewest candidates, as many as a search can handle.

    They fix the motion; the others follow by their gates around it (:class:`ekf_slam_node.association.linking.Linker`).
    """
    seen = predict(candidates, T_previous_now, T_rig_optical, frame)
    pairs = _clearest_pairs(candidates, frame, seen, motion_covariance, config)
    rows, columns = np.unique(pairs[0]), np.unique(pairs[1])
    J = seen.J_pose[rows].reshape(-1, 6)
    joint = J @ motion_covariance @ J.T
    own = innovation_covariance(seen, candidates, None)[rows]
    for k in range(len(rows)):
        joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own[k]
    noise = frame.variance[columns][:, :, None] * np.eye(3)
    found = jcbb(frame.z[columns], noise, JointPrediction(seen.z[rows], joint), confidence=_JOINT_CONFIDENCE)
    return rows[found[found >= 0]], columns[found >= 0]


def associate_ccda(
    candidates: Candidates, frame: Frame, T_previous_now: FloatArray, motion_covariance: FloatArray,
    T_rig_optical: FloatArray, config: FeatureAssociationConfig,
) -> tuple[IndexArray, IndexArray]:  # fmt: skip
    """The most pairs whose points are two by two equally far apart (thesis 9.4.1), of the same features as JCBB's.

    The motion only says which pairs are possible at all; with a covariance without bounds their descriptors do.
    """
    seen = predict(candidates, T_previous_now, T_rig_optical, frame)
    rows, columns, costs = _clearest_pairs(candidates, frame, seen, motion_covariance, config)
    before, now = candidates.points[rows], rig_points(frame.select(columns), T_rig_optical)
    fits = equal_distances(
        (before, distance_variances(before, candidates.covariances[rows])),
        (now[0], distance_variances(*now)),
        chi_square_bound(_JOINT_CONFIDENCE, 1),
    )
    found = ccda(rows, columns, costs, fits, len(frame))
    paired = np.flatnonzero(found >= 0)
    return found[paired], paired


def _clearest_pairs(
    candidates: Candidates,
    frame: Frame,
    seen: Observation,
    motion_covariance: FloatArray,
    config: FeatureAssociationConfig,
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Rows, columns and costs of the gated pairs of the features with the fewest candidates."""
    S = innovation_covariance(seen, candidates, motion_covariance)
    rows, columns, costs = _gated_pairs(
        frame.z, frame.variance, frame.descriptors, seen.z, S, seen.in_image(frame.camera), candidates.descriptors,
        config.descriptor_threshold, config.gate, 0.0,
    )  # fmt: skip
    choices = np.bincount(columns, minlength=len(frame))
    clearest = np.argsort(np.where(choices > 0, choices, np.iinfo(np.int64).max), kind="stable")
    kept = np.isin(columns, clearest[:_JOINT_FEATURES])
    return rows[kept], columns[kept], costs[kept]
