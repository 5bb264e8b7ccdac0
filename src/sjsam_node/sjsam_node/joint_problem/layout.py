# SPDX-License-Identifier: Apache-2.0
"""Layout of the variables in the normal equations: the symbolic part of the joining problem.

Landmarks that are seen by exactly the same local maps have the same neighbours in the elimination graph. They form one
*group*: ordering and symbolic factorisation then work on a few groups per local map instead of on every landmark. A
pose is a group of its own. *Nodes* number the poses first, then the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sjsam_node.joint_problem.problem import FlatMaps
from slam_core.linear_algebra.block_pattern import BlockPattern, IntArray, pointers
from slam_core.linear_algebra.sparse_cholesky import elimination_order


class Scatter(NamedTuple):
    """Places of each local map's normal equations, as ``kernels.joint_linearize`` reads them.

    An *item* is a pose or landmark of a local map: it belongs to one of the map's local groups, at an offset, with a
    width. For every pair of local groups (first >= second): the position of its first entry among the stored values
    (-1 if one of them is fixed), the distance of its columns there, and whether the pair is stored transposed.
    """

    item_ptr: IntArray
    item_group: IntArray
    item_offset: IntArray
    item_width: IntArray
    group_ptr: IntArray
    group_start: IntArray
    pair_ptr: IntArray
    pair_position: IntArray
    pair_stride: IntArray
    pair_swapped: IntArray


@dataclass(frozen=True, eq=False)
class Layout:
    """Order of the variables and pattern of the normal equations.

    pose_offset (P,), landmark_offset (L,): first scalar of each variable, -1 for one that is fixed or not observed.
    """

    pose_offset: IntArray
    landmark_offset: IntArray
    pattern: BlockPattern
    scatter: Scatter


@dataclass(frozen=True, eq=False)
class _Groups:
    of_node: IntArray
    width: IntArray
    start: IntArray
    rank: IntArray


def make_layout(
    maps: FlatMaps, pose_count: int, landmark_count: int, fixed: IntArray, dimension: int, last: IntArray | None = None
) -> Layout:
    """Order the variables and lay out the normal equations.

    Parameters
    ----------
    maps
        The local maps, over ``pose_count`` poses and ``landmark_count`` landmarks.
    pose_count, landmark_count
        Size of the state.
    fixed
        Poses that are not estimated (the gauge).
    dimension
        2 or 3.
    last
        Nodes to eliminate last, as one clique, so that the end of the factor is their marginal information.
    """
    count = len(maps.reference)
    last = np.empty(0, dtype=np.int64) if last is None else last
    item_map, node = _items(maps, pose_count)
    widths = _node_widths(node, pose_count, landmark_count, fixed, dimension)
    of_node = _group_nodes(item_map, node, pose_count, landmark_count, last)
    # The clique of the last variables is one more map without values.
    item_map, node = np.concatenate([item_map, np.full(len(last), count)]), np.concatenate([node, last])
    key, local = np.unique(item_map * (of_node.max() + 1) + of_node[node], return_inverse=True)
    local_map, local_group = key // (of_node.max() + 1), key % (of_node.max() + 1)
    group_ptr = np.searchsorted(local_map, np.arange(count + 2))
    first, second, pair_ptr = _pairs(group_ptr)
    a, b = local_group[first], local_group[second]
    groups = _order(of_node, widths, a, b, np.unique(of_node[last]))
    pattern, position, stride = _pattern(groups, a, b)
    offset = _offset_in_group(of_node, widths)
    start = np.where(widths > 0, groups.start[of_node] + offset, -1)
    scatter = Scatter(
        np.searchsorted(item_map, np.arange(count + 2)), local.ravel() - group_ptr[item_map], offset[node],
        np.where(node < pose_count, 3 if dimension == 2 else 6, dimension),
        group_ptr, np.where(groups.width > 0, groups.start, -1)[local_group],
        pair_ptr, position, stride, (groups.rank[a] < groups.rank[b]).astype(np.int64),
    )  # fmt: skip
    return Layout(start[:pose_count], start[pose_count:], pattern, scatter)


def _items(maps: FlatMaps, pose_count: int) -> tuple[IntArray, IntArray]:
    """(map, node) of every pose and landmark of every local map, in local order: reference, poses, landmarks."""
    count = len(maps.reference)
    in_map = [
        np.arange(count),
        np.repeat(np.arange(count), np.diff(maps.pose_ptr)),
        np.repeat(np.arange(count), np.diff(maps.landmark_ptr)),
    ]
    kind = np.repeat(np.arange(3), [len(part) for part in in_map])
    item_map = np.concatenate(in_map)
    poses, landmarks = maps.poses[: maps.pose_ptr[-1]], maps.landmarks[: maps.landmark_ptr[-1]]
    order = np.lexsort((kind, item_map))
    return item_map[order], np.concatenate([maps.reference, poses, landmarks + pose_count])[order]


def _node_widths(node: IntArray, pose_count: int, landmark_count: int, fixed: IntArray, dimension: int) -> IntArray:
    """Scalars of every node; 0 where it is fixed or in no local map."""
    widths = np.zeros(pose_count + landmark_count, dtype=np.int64)
    widths[node] = np.where(node < pose_count, 3 if dimension == 2 else 6, dimension)
    widths[fixed] = 0
    return widths


def _group_nodes(item_map: IntArray, node: IntArray, pose_count: int, landmark_count: int, last: IntArray) -> IntArray:
    """Group of every node: one per pose, one per set of landmarks that the same maps see."""
    signature = np.zeros(pose_count + landmark_count, dtype=np.uint64)
    np.add.at(signature, node, _mix(item_map + 1))
    np.add.at(signature, last, _mix(np.zeros(len(last), dtype=np.int64)))
    _, landmark_group = np.unique(signature[pose_count:], return_inverse=True)
    return np.concatenate([np.arange(pose_count), pose_count + landmark_group.ravel()]).astype(np.int64)


def _mix(values: IntArray) -> npt.NDArray[np.uint64]:
    """Well mixed 64-bit hash (splitmix64, Steele et al. 2014), so that sums of hashes tell sets of maps apart."""
    x = (values.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(x ^ (x >> np.uint64(31)))


def _pairs(group_ptr: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """All pairs (first >= second) of local groups of each map.

    Row by row of a lower triangle, and where each map starts.
    """
    sizes = np.diff(group_ptr)
    local = np.arange(group_ptr[-1]) - np.repeat(group_ptr[:-1], sizes)
    first = np.repeat(np.arange(group_ptr[-1]), local + 1)
    row_start = pointers(local + 1)
    second = (
        np.arange(len(first))
        - np.repeat(row_start[:-1], local + 1)
        + np.repeat(np.repeat(group_ptr[:-1], sizes), local + 1)
    )
    return first, second, row_start[group_ptr]


def _order(of_node: IntArray, widths: IntArray, a: IntArray, b: IntArray, last: IntArray) -> _Groups:
    """Elimination order of the groups: fill-reducing, with the groups ``last`` moved to the end."""
    count = int(of_node.max()) + 1
    width = np.bincount(of_node, weights=widths, minlength=count).astype(np.int64)
    free = (width[a] > 0) & (width[b] > 0)
    order = elimination_order(count, a[free], b[free])
    is_last = np.isin(order, last)
    order = np.concatenate([order[~is_last], order[is_last]])
    rank, start = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    start[order] = pointers(width[order])[:-1]
    return _Groups(of_node, width, start, rank)


def _pattern(groups: _Groups, a: IntArray, b: IntArray) -> tuple[BlockPattern, IntArray, IntArray]:
    """Block pattern of all pairs; for each pair the position of its first entry and the distance of its columns."""
    count = len(groups.width)
    free = (groups.width[a] > 0) & (groups.width[b] > 0)
    column, row = np.minimum(groups.rank[a], groups.rank[b]), np.maximum(groups.rank[a], groups.rank[b])
    key, inverse = np.unique((column * count + row)[free], return_inverse=True)
    width = np.empty(count, dtype=np.int64)
    width[groups.rank] = groups.width
    pattern = BlockPattern(width, np.searchsorted(key // count, np.arange(count + 1)), key % count)
    position = np.full(len(a), -1, dtype=np.int64)
    position[free] = (pattern.value_ptr[key // count] + pattern.row_offset)[inverse.ravel()]
    return pattern, position, pattern.height[column]


def _offset_in_group(of_node: IntArray, widths: IntArray) -> IntArray:
    """First scalar of every node inside its group."""
    order = np.argsort(of_node, kind="stable")
    total = pointers(widths[order])[:-1]
    group_first = np.searchsorted(of_node[order], of_node[order])
    offset = np.empty(len(order), dtype=np.int64)
    offset[order] = total - total[group_first]
    return offset
