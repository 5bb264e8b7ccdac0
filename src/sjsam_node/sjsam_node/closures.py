"""Links between submaps: to the ones just before, to ones the estimate says are near, and to ones that look alike.

A link is believed only after three questions: do enough landmarks, spread in space, agree on one rigid alignment
within both submaps' joint covariance; does that alignment agree with what the map already knows of the two poses;
and, where the map knows little, does a second link say the same. Two rooms that look alike fail the second or the
third.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from sjsam_node.association import (
    Alignment,
    AssociationConfig,
    PointSet,
    Prior,
    jointly_compatible,
    match,
    mutual_best,
    similarity,
    turned,
)  # fmt: skip
from sjsam_node.map_graph import Link, MapGraph, Record
from sjsam_node.near_pairs import Chain, NearPairs
from sjsam_node.novelty import Novelty
from sjsam_node.place_recognition import PlaceIndex, PlaceRecognitionConfig
from slam_core.config import Config, group, parameter
from slam_core.geometry import (
    FloatArray,
    boxminus,
    compose_covariance,
    compose_jacobians,
    inverse_jacobian,
    invert_transform,
    skew,
)  # fmt: skip
from slam_core.least_squares import chi_square_bound
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.rigid_alignment import ransac_rigid_transform

RelativePose = Callable[[int, int], "Prior | None"]
"""Given two records: T_first_second of their starts with covariance, None if the map says nothing (other component)."""


@dataclass(frozen=True)
class ClosureConfig(Config):
    """What a link between submaps must show before it is believed."""

    window: int = parameter(3, "submaps back along the agent's path that a new one is linked to directly", minimum=1)
    proximity: float = parameter(
        3.0, "distance between the middles of submaps that are tried as near", unit="m", minimum=0.0
    )
    near_candidates: int = parameter(4, "near submaps tried per new one", minimum=0)
    informative_sigma: float = parameter(
        0.5, "largest standard deviation of a relative position that can tell two places apart", unit="m", minimum=0.0
    )
    drift: float = parameter(
        0.01, "drift of odometry to expect beyond its covariance, per metre of way, one sigma", unit="m/m", minimum=0.0
    )
    drift_angle: float = parameter(0.003, "the same for rotation", unit="rad/m", minimum=0.0)
    ratio: float = parameter(
        0.9, "second best to best angle of descriptors, where no prior helps", minimum=0.1, maximum=1.0
    )
    place_threshold: float = parameter(0.7, "least scalar product of descriptors, where no prior helps", maximum=1.0)
    ransac_distance: float = parameter(
        0.15, "largest distance of an inlier of the first alignment", unit="m", minimum=0.001
    )
    min_near_inliers: int = parameter(5, "least matches of a link to a near submap", minimum=3)
    min_inliers: int = parameter(10, "least matches of a link to a submap found by its looks", minimum=3)
    min_spread: float = parameter(
        0.25, "least second-largest standard deviation of the matched landmarks", unit="m", minimum=0.0
    )
    min_overlap: float = parameter(
        0.3, "least share of the landmarks expected in both that match", minimum=0.0, maximum=1.0
    )
    confirmations: int = parameter(2, "links that must agree where the map cannot judge", minimum=1)
    probability: float = parameter(
        0.9999, "share of true closures inside the chi-square gate", minimum=0.9, maximum=0.9999999
    )
    seed: int = parameter(1, "seed of the random samples", minimum=0)
    association: AssociationConfig = group(AssociationConfig)
    places: PlaceRecognitionConfig = group(PlaceRecognitionConfig)


def at_start(record: Record) -> PointSet:
    """Landmarks of a record in its start frame."""
    submap = record.submap
    return PointSet(submap.landmarks, submap.covariance[6:, 6:], submap.descriptors)


def at_end(record: Record) -> PointSet:
    """Landmarks of a record as seen from its end pose, with the exact joint covariance of both (Eq. 7.2 applied to
    it).
    """
    submap = record.submap
    R, t = submap.end_pose[:3, :3], submap.end_pose[:3, 3]
    own = np.broadcast_to(-R.T, (len(submap.landmarks), 3, 3))
    J_end = np.concatenate([own, R.T @ skew(submap.landmarks - t)], axis=2).reshape(-1, 6)
    half = _as_seen(submap.covariance, R, J_end)
    return PointSet((submap.landmarks - t) @ R, _as_seen(half.T, R, J_end), submap.descriptors)


def _as_seen(rows: FloatArray, R: FloatArray, J_end: FloatArray) -> FloatArray:
    """``J rows`` for the Jacobian of (end pose, landmarks): ``J_end`` (3n, 6), and ``R^T`` for each landmark's own."""
    return J_end @ rows[:6] + turned(rows[6:], R.T)


class Standing(Enum):
    """What the map says of an alignment: it vouches for it, it cannot judge, or it knows otherwise."""

    CERTAIN = auto()
    LIKELY = auto()
    CONTRADICTED = auto()


class Findings(NamedTuple):
    """Closures that may be believed, and those that look right but contradict the map, which may itself be wrong."""

    believed: list[Link]
    contradicted: list[Link]


@dataclass
class LinkFinder:
    """Finds and judges the links of a new record."""

    config: ClosureConfig = field(default_factory=ClosureConfig)
    index: PlaceIndex = field(init=False)
    near: NearPairs = field(init=False)
    pending: list[Link] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.index = PlaceIndex(self.config.places)
        self.near = NearPairs(self.config.proximity, self._neighbours, self.config.association.position_noise)

    @property
    def _neighbours(self) -> int:
        """Near submaps that are of interest: several passes and agents crowd around one place."""
        return 4 * self.config.near_candidates

    def sequential(self, graph: MapGraph, chain: list[int], new: int) -> list[Link]:
        """Links of record ``new`` to the records ``chain`` before it, newest first, by their odometry."""
        links, T, covariance = [], np.eye(4), np.zeros((6, 6))
        for k, previous in enumerate(chain[: self.config.window]):
            record = graph.records[previous]
            prior = Prior(T, covariance if k else None)
            found = match(at_end(record), at_start(graph.records[new]), prior, self.config.association)
            if len(found.pairs):
                end = record.submap.end_pose
                end_covariance = record.submap.covariance[:6, :6]
                links.append(Link(previous, new, found.pairs, end @ found.T,
                                  compose_covariance(end, end_covariance, found.T, found.covariance)))  # fmt: skip
            covariance = compose_covariance(record.submap.end_pose, record.submap.covariance[:6, :6], T, covariance)
            T = record.submap.end_pose @ T
        return links

    def closures(self, graph: MapGraph, chain: list[int], new: int, relative_pose: RelativePose) -> Findings:
        """Links of record ``new`` beyond its chain; some may wait for confirmation."""
        recent = {*range(new, len(graph.records)), *chain[: self.config.window]}
        around = self._near(graph, new, recent)
        near, further = around[: self.config.near_candidates], around[self.config.near_candidates :]
        looks = self.index.query(graph.records[new].submap.descriptors, recent | set(near))
        second, known = at_start(graph.records[new]), self._novelty(graph)
        alike = [old for old in looks if self._is_alike(at_start(graph.records[old]), second)]
        found = self._judged(graph, [(old, new) for old in [*near, *alike]], relative_pose, known)
        if not known.is_known(new):
            return found
        # The map knows where it is: what else lies there is compared before all is joined, not after.
        more = self._judged(graph, [(old, new) for old in further if old not in alike], relative_pose, known)
        return Findings(found.believed + more.believed, found.contradicted + more.contradicted)

    def missed(self, graph: MapGraph, chain: Chain, relative_pose: RelativePose, most: int | None = None) -> Findings:
        """Links between records that have come near each other since they were compared, if ever they were.

        ``most`` pairs are compared, the nearest; None for all.
        """
        return self._judged(graph, self.near.due(graph, chain)[:most], relative_pose, self._novelty(graph))

    def _novelty(self, graph: MapGraph) -> Novelty:
        config = self.config
        return Novelty(
            graph, config.min_near_inliers, config.association.descriptor_threshold, config.ransac_distance
        )  # fmt: skip

    def _judged(
        self, graph: MapGraph, pairs: list[tuple[int, int]], relative_pose: RelativePose, known: Novelty
    ) -> Findings:
        """What geometry and the map say of pairs of records, but for those of which nothing new can be learnt."""
        believed: list[Link] = []
        contradicted: list[Link] = []
        for old, new in pairs:
            if known.is_all_known(old, new):
                self.near.note(graph, old, new)
                continue
            first, second = at_start(graph.records[old]), at_start(graph.records[new])
            prior, way = relative_pose(old, new), graph.way_between(old, new)
            if prior is not None:
                self.near.note(graph, old, new)
            found, standing = self.judge(first, second, prior, way, old, new)
            if found is None:
                continue
            link = Link(old, new, found.pairs, found.T, found.covariance, True)
            if standing is Standing.CERTAIN:
                known.note(link)
                believed.append(link)
            elif standing is Standing.CONTRADICTED:
                contradicted.append(link)
            else:
                tension = 0.0 if prior is None else self._tension(found, prior, 0.0)
                believed += self._confirmed(graph, replace(link, tension=tension))
        return Findings(believed, contradicted)

    def _near(self, graph: MapGraph, new: int, recent: set[int]) -> list[int]:
        """Older records of the same component whose landmarks are around those of ``new``, nearest first."""
        return self.around(
            graph, _middle(graph, new), graph.records_of(graph.component(new)), recent, self._neighbours
        )  # fmt: skip

    def around(
        self, graph: MapGraph, middle: FloatArray, records: Iterable[int], excluded: set[int], most: int | None = None
    ) -> list[int]:
        """Those of ``records`` whose landmarks are around a point (3,) of the map, nearest first.

        ``most`` of them, by default as many as are tried.
        """
        candidates = np.array([i for i in records if i not in excluded], dtype=np.int64)
        distance = np.linalg.norm(graph.middles(candidates) - middle, axis=1)
        ranked = sorted((d, i) for d, i in zip(distance.tolist(), candidates.tolist(), strict=True)
                        if d < self.config.proximity)  # fmt: skip
        return [i for _, i in ranked[: self.config.near_candidates if most is None else most]]

    def judge(
        self, first: PointSet, second: PointSet, prior: Prior | None, way: float, *key: int
    ) -> tuple[Alignment | None, Standing]:
        """The alignment of two submaps if geometry supports it, and what the prior says of it.

        ``way`` is the length of the path between them, m: what the prior does not know is at least its drift.
        ``key`` seeds the random samples, so that the same pair is always judged alike.
        """
        informative = prior is not None and _sigma(prior.covariance) < self.config.informative_sigma
        if informative and prior is not None:
            found = self._around(first, second, prior)
            if len(found.pairs) >= self.config.min_near_inliers and self._overlaps(first, second, found):
                return found, Standing.CERTAIN
        guess = self._by_looks(first, second, key)
        if guess is None or not self._supported(first, second, guess):
            return None, Standing.LIKELY
        if prior is not None and self._tension(guess, prior, way) > chi_square_bound(self.config.probability, 6):
            return guess, Standing.CONTRADICTED
        return guess, Standing.LIKELY

    def _around(self, first: PointSet, second: PointSet, prior: Prior) -> Alignment:
        """Match around a prior, then around what that found, as long as it finds more.

        A map too sure of itself admits only matches that agree with its error; further ones show where they lead.
        """
        assert prior.covariance is not None
        found = match(first, second, prior, self.config.association)
        loose = self.config.association.max_variance_factor * prior.covariance
        while True:
            more = match(first, second, Prior(found.T, loose), self.config.association)
            if len(more.pairs) <= len(found.pairs):
                return found
            found = more

    def _by_looks(self, first: PointSet, second: PointSet, key: tuple[int, ...]) -> Alignment | None:
        """Alignment from descriptors alone, refined with all landmarks around it."""
        pairs = self._distinct_pairs(first, second)
        if len(pairs) < self._few_pairs:
            return None
        rng = np.random.default_rng([self.config.seed, *key])
        coarse = ransac_rigid_transform(
            second.points[pairs[:, 1]], first.points[pairs[:, 0]], self.config.ransac_distance, rng,
            min_inliers=self._few_pairs,
        )  # fmt: skip
        if not coarse.success:
            return None
        loose = np.diag([self.config.ransac_distance**2] * 3 + [0.05**2] * 3)
        found = match(first, second, Prior(coarse.T, loose), self.config.association)
        # The guess came from the same landmarks: without its weight the covariance is that of the landmarks alone.
        free = Prior(found.T, 1e4 * np.eye(6))
        return jointly_compatible(first, second, found.pairs, free, self.config.association)

    @property
    def _few_pairs(self) -> int:
        return max(3, self.config.min_inliers // 2)

    def _is_alike(self, first: PointSet, second: PointSet) -> bool:
        """Whether descriptors alone leave a chance, before anything dearer is asked."""
        return len(self._distinct_pairs(first, second)) >= self._few_pairs

    def _distinct_pairs(self, first: PointSet, second: PointSet) -> IntArray:
        """Mutually best descriptor pairs, clearly better than the second best."""
        S = similarity(first, second)
        if min(S.shape) < 2:
            return np.empty((0, 2), dtype=np.int64)
        i, j = np.nonzero(self.config.place_threshold <= S)
        pairs = mutual_best(i, j, -S[i, j].astype(np.float64))
        angle = np.arccos(np.clip(np.partition(S[pairs[:, 0]], -2, axis=1)[:, -2:], -1.0, 1.0))
        return pairs[angle[:, 1] <= self.config.ratio * angle[:, 0]]

    def _supported(self, first: PointSet, second: PointSet, found: Alignment) -> bool:
        return len(found.pairs) >= self.config.min_inliers and self._overlaps(first, second, found)

    def _overlaps(self, first: PointSet, second: PointSet, found: Alignment) -> bool:
        """Matches are spread, and most landmarks that lie among them on both sides are matched."""
        matched = first.points[found.pairs[:, 0]]
        if np.sqrt(max(np.linalg.eigvalsh(np.cov(matched.T))[1], 0.0)) < self.config.min_spread:
            return False
        low, high = matched.min(axis=0), matched.max(axis=0)
        moved = second.points @ found.T[:3, :3].T + found.T[:3, 3]
        expected = min(_inside(first.points, low, high), _inside(moved, low, high))
        return len(matched) >= self.config.min_overlap * expected

    def _tension(self, found: Alignment, prior: Prior, way: float) -> float:
        """Normalised squared error of an alignment against the prior, which has drifted along the ``way`` (m)."""
        assert prior.covariance is not None
        error = boxminus(found.T, prior.T)
        drift = np.diag([(self.config.drift * way) ** 2] * 3 + [(self.config.drift_angle * way) ** 2] * 3)
        return float(error @ np.linalg.solve(prior.covariance + found.covariance + drift, error))

    def _confirmed(self, graph: MapGraph, link: Link) -> list[Link]:
        """The link with those waiting that say the same, if together they are enough; otherwise it waits too."""
        agreeing = [other for other in self.pending if self._same_loop(graph, other, link)]
        self.pending.append(link)
        if len(agreeing) + 1 < self.config.confirmations:
            return []
        group_ = [*agreeing, link]
        self.pending = [p for p in self.pending if not any(p is g for g in group_)]
        return group_

    @staticmethod
    def _same_loop(graph: MapGraph, a: Link, b: Link) -> bool:
        """Whether two links between the same parts of the map move the second part alike, within what both claim."""
        if (graph.component(a.first), graph.component(a.second)) != (
            graph.component(b.first),
            graph.component(b.second),
        ):
            b = b.inverted()
            if (graph.component(a.first), graph.component(a.second)) != (
                graph.component(b.first), graph.component(b.second),
            ):  # fmt: skip
                return False
        if {a.first, a.second} == {b.first, b.second}:
            return False
        T_a, T_b = _movement(graph, a), _movement(graph, b)
        here, there = _middle(graph, b.second), _middle(graph, a.second)
        gap = np.linalg.norm((T_a[:3, :3] - T_b[:3, :3]) @ here + T_a[:3, 3] - T_b[:3, 3])
        # Between the two the odometry has drifted on both stretches.
        way = np.linalg.norm(there - here) + np.linalg.norm(_middle(graph, a.first) - _middle(graph, b.first))
        allowed = 0.1 + 0.05 * way + 3.0 * (_sigma(a.covariance) + _sigma(b.covariance))
        return bool(gap < allowed and np.linalg.norm(boxminus(T_a, T_b)[3:]) < 0.15)


def _movement(graph: MapGraph, link: Link) -> FloatArray:
    """How a link would move the part of the map that its second record is in."""
    T_first, T_second = (graph.poses[graph.records[i].start] for i in (link.first, link.second))
    return np.asarray(T_first @ link.T @ invert_transform(T_second))


def prior_of_pair(T_a_b: FloatArray, covariance: FloatArray) -> Prior:
    """A prior with a covariance that can be inverted: two poses that are tied exactly get a micrometre."""
    return Prior(T_a_b, covariance + 1e-12 * np.eye(6))


def relative_pose(T_map_a: FloatArray, T_map_b: FloatArray, joint: FloatArray) -> tuple[FloatArray, FloatArray]:
    """T_a_b of two poses with joint covariance (12, 12), and its covariance (6, 6)."""
    T_a_map = invert_transform(T_map_a)
    J_a, J_b = compose_jacobians(T_a_map, T_map_b)
    J = np.concatenate([J_a @ inverse_jacobian(T_map_a), J_b], axis=1)
    return T_a_map @ T_map_b, J @ joint @ J.T


def _middle(graph: MapGraph, record: int) -> FloatArray:
    return np.asarray(graph.middles(np.array([record]))[0])


def _sigma(covariance: FloatArray | None) -> float:
    """Largest standard deviation of a position, m."""
    return 0.0 if covariance is None else float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _inside(points: FloatArray, low: FloatArray, high: FloatArray) -> int:
    return int(np.all((points >= low) & (points <= high), axis=1).sum())
