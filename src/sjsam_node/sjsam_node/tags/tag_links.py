# SPDX-License-Identifier: Apache-2.0
"""Links between submaps that saw the same fiducial tag: its corners are landmarks with known names.

A tag's name is evidence that looks never are, so that a link by one needs no other. It can still be wrong, of a tag
that was moved or printed twice: the map's pose and the odometry are asked, as for every closure, and one that they
contradict waits (:mod:`sjsam_node.consistency.closure_joining`). The *places* of a tag are the landmarks that its
sightings were joined to: more than one in a part of the map means that it was moved, or that there are two.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.graph.links import Link, Prior, Status
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.loop_closure.association import (
    MAX_VARIANCE_FACTOR,
    Alignment,
    AssociationConfig,
    PointSet,
    align,
    jointly_compatible,
)
from sjsam_node.loop_closure.point_sets import at_end, at_start
from sjsam_node.loop_closure.verification import CLOSURE_PROBABILITY, Verifier
from sjsam_node.smoothing.estimate import MapEstimate
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import boxminus, compose_covariance, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.tags import CORNERS, whole_tags
from slam_core.types import Submap

_LEAST_SIGHTINGS = 2
"""A tag seen once in a submap may be a misreading."""
_MOST_COMPARED = 6
"""Older submaps that a new one is compared with by its tags."""
_FREE = 1e4 * np.eye(6)
"""Covariance (m2, rad2) of a pose that nothing is known of."""
_SAME_PLACE = 0.5
"""Distance in edges below which two tags would cover each other."""
_ELSEWHERE = 4.0
"""Distance in edges beyond which a tag is somewhere else."""
_LEAST_APART = 2
"""Common tags elsewhere, from which on an alignment is false; one may have been moved."""


def tags_of(submap: Submap) -> dict[int, IntArray]:
    """Rows (4,) of the corners of each tag of a submap."""
    ids = submap.landmark_ids
    if not len(ids) or ids.min() >= 0:
        return {}
    tags = whole_tags(ids)
    return {tag: rows for tag, rows in tags.items() if submap.sightings[rows].min() >= _LEAST_SIGHTINGS}


@dataclass
class TagLinks:
    """Finds links by tags; ``holders``: the records that saw each tag, ascending."""

    estimate: MapEstimate
    verifier: Verifier
    holders: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))

    @property
    def graph(self) -> MapGraph:
        """Graph in which links are looked for."""
        return self.estimate.graph

    def add(self, new: int) -> None:
        """Take notice of the tags of a new record."""
        for tag in tags_of(self.graph.records[new].submap):
            self.holders[tag].append(new)

    def sequential(self, chain: Sequence[int], new: int) -> list[Link]:
        """Links of a new record by the tags that the records ``chain`` before it saw too, newest first."""
        own, links = tags_of(self.graph.records[new].submap), []
        T, covariance = np.eye(4), np.zeros((6, 6))
        for previous in chain if own else ():
            submap = self.graph.records[previous].submap
            end, end_covariance = submap.end_pose, submap.covariance[:6, :6]
            shared = [tag for tag in own if tag in (theirs := tags_of(submap))]
            if shared:
                pairs = np.concatenate([np.stack([theirs[t], own[t]], axis=1) for t in shared])
                first, second = at_end(self.graph.records[previous]), at_start(self.graph.records[new])
                prior = Prior(T, covariance + 1e-12 * np.eye(6))
                found = _agreeing(first, second, pairs, prior, self.verifier.config.association)
                if found is not None:
                    P = compose_covariance(end, end_covariance, found.T, found.covariance)
                    links.append(Link(previous, new, found.pairs, end @ found.T, P))
                    joined = set(found.pairs[:, 1].tolist())
                    own = {tag: rows for tag, rows in own.items() if int(rows[0]) not in joined}
            covariance = compose_covariance(end, end_covariance, T, covariance)
            T = end @ T
        return links

    def closures(self, chain: Sequence[int], new: int) -> list[Link]:
        """Links of a new record to older ones that saw a tag at a place that the new one is not tied to yet."""
        own = tags_of(self.graph.records[new].submap)
        recent = {new, *chain}
        wanted = {(tag, place) for tag in own for place in self._places(tag, recent)}
        wanted -= {(tag, self._place(new, rows)) for tag, rows in own.items()}
        links: list[Link] = []
        for old in self._candidates(wanted, recent)[:_MOST_COMPARED]:
            theirs = tags_of(self.graph.records[old].submap)
            here = [t for t in own if t in theirs and (t, self._place(old, theirs[t])) in wanted]
            if not here or (link := self._compared(old, new, {t: (theirs[t], own[t]) for t in here})) is None:
                continue
            links.append(link)
            if link.status is Status.CONSISTENT:  # whatever else carries these tags is not them
                joined = set(link.pairs[:, 1].tolist())
                told = {t for t in here if int(own[t][0]) in joined}
                wanted = {(t, place) for t, place in wanted if t not in told}
        return links

    def _place(self, record: int, rows: IntArray) -> int:
        return int(self.graph.landmarks_of(record)[rows[0]])

    def _places(self, tag: int, excluded: set[int]) -> set[int]:
        """Landmarks of a tag's first corner in the records that saw it."""
        others = (i for i in self.holders.get(tag, ()) if i not in excluded)
        return {self._place(i, tags_of(self.graph.records[i].submap)[tag]) for i in others}

    def _candidates(self, wanted: set[tuple[int, int]], excluded: set[int]) -> list[int]:
        """Records that saw tags at wanted places, those with most of them first, of these the newest."""
        count: dict[int, int] = defaultdict(int)
        for tag in {t for t, _ in wanted}:
            for i in self.holders[tag]:
                rows = tags_of(self.graph.records[i].submap)[tag]
                count[i] += i not in excluded and (tag, self._place(i, rows)) in wanted
        return sorted((i for i, n in count.items() if n), key=lambda i: (-count[i], -i))

    def _compared(self, old: int, new: int, shared: dict[int, tuple[IntArray, IntArray]]) -> Link | None:
        """The closure of two records by tags; None if they do not have the same shape in both."""
        first, second = at_start(self.graph.records[old]), at_start(self.graph.records[new])
        pairs = np.concatenate([np.stack(rows, axis=1) for rows in shared.values()])
        found = self._aligned(first, second, pairs)
        if found is None:
            return None
        prior, path_length = self.estimate.relative_pose(old, new), self.graph.path_length_between(old, new)
        status, error = Status.CONSISTENT, 0.0
        if prior is not None:
            is_off = self.verifier.is_against(found, prior, path_length)
            status = Status.INCONSISTENT if is_off else Status.CONSISTENT
            error = self.verifier.error_against(found, prior, 0.0)
        return Link(old, new, found.pairs, found.T, found.covariance, True, error, status)

    def _aligned(self, first: PointSet, second: PointSet, pairs: IntArray) -> Alignment | None:
        """Alignment by the tags that agree on one; the others are left out whole."""
        config = self.verifier.config.association
        start = umeyama(second.points[pairs[:, 1]], first.points[pairs[:, 0]])
        coarse = align(first, second, pairs, Prior(start, _FREE), config)
        return _agreeing(first, second, pairs, Prior(coarse.T, _FREE), config)


def _agreeing(
    first: PointSet, second: PointSet, pairs: IntArray, prior: Prior, config: AssociationConfig
) -> Alignment | None:
    """Alignment by the tags all of whose corners agree with it; ``pairs``: four of each tag, tag by tag."""
    while len(pairs):
        found = jointly_compatible(first, second, pairs, prior, config)
        kept = np.isin(pairs[:, 1], found.pairs[:, 1]).reshape(-1, CORNERS).all(axis=1)
        if kept.all():
            return found
        pairs = pairs[np.repeat(kept, CORNERS)]
    return None


def with_tag_links(links: Sequence[Link], by_tags: Sequence[Link]) -> list[Link]:
    """Links by looks and by tags, one of the same two records; where these disagree the one by tags stays."""
    tagged = {k.ends: k for k in by_tags}
    out = []
    for link in links:
        other = tagged.get(link.ends)
        if other is None:
            out.append(link)
            continue
        apart = boxminus(link.T, other.T)
        nis = apart @ np.linalg.solve(link.covariance + other.covariance, apart)
        if nis <= MAX_VARIANCE_FACTOR * chi_square_bound(CLOSURE_PROBABILITY, 6):
            tagged[link.ends] = replace(link, pairs=np.concatenate([link.pairs, other.pairs]))
    return out + list(tagged.values())


def is_against_tags(graph: MapGraph, first: int, second: int, found: Alignment) -> bool:
    """True if an alignment by looks puts two different tags in one place, or most of the common ones elsewhere."""
    a, b = graph.records[first].submap, graph.records[second].submap
    here, there = tags_of(a), tags_of(b)
    if not here or not there:
        return False
    middle = {tag: a.landmarks[rows].mean(axis=0) for tag, rows in here.items()}
    apart, together = 0, 0
    for tag, rows in there.items():
        corners = transform_points(found.T, b.landmarks[rows])
        edge = float(np.linalg.norm(corners[0] - corners[1]))
        seen = corners.mean(axis=0)
        for other, place in middle.items():
            gap = float(np.linalg.norm(place - seen))
            if other != tag and gap < _SAME_PLACE * edge:
                return True
            apart += other == tag and gap > _ELSEWHERE * edge
            together += other == tag and gap <= _ELSEWHERE * edge
    return apart >= _LEAST_APART and apart > together
