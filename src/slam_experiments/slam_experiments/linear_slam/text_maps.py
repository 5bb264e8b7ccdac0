# SPDX-License-Identifier: Apache-2.0
"""Text submaps of Linear SLAM (Zhao, Huang and Dissanayake, IROS 2013), 2D and 3D, with landmarks or as pose graphs.

A file ``localmap_<k>.txt`` holds: ``Ref``, the id of the pose whose frame the map is in; N; N lines ``id value``; the
N x N information matrix. The values of one id stand together: a pose is x y phi in 2D and x y z yaw pitch roll in 3D
(so that the rotation to the reference frame is ``Rz(yaw) Ry(pitch) Rx(roll)``), a feature x y or x y z. Ids of
features are positive; poses count down from 0 in sets with features and up in pose graphs, so that a pose and a
feature may share a number. Where poses count down, ``Ref`` is written without its sign. An id may stand twice in one
map, where a pose came in by two ways: the two are one unknown, and their joint information says what it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.storage.files import read_text


@dataclass(frozen=True, eq=False)
class TextMap:
    """One file.

    Reference pose id, ids and values of the poses (k, 3 | 6) and features (n, 2 | 3), information (m, m).
    """

    reference: int
    pose_ids: IntArray
    poses: FloatArray
    feature_ids: IntArray
    features: FloatArray
    information: FloatArray


def find_maps(folder: Path) -> list[Path]:
    """The files ``localmap_<k>.txt`` of a folder in the order of their numbers.

    Raises
    ------
    ValueError
        If there is none.
    """
    numbered = [
        (int(match[1]), path) for path in folder.iterdir() if (match := re.fullmatch(r"localmap_(\d+)\.txt", path.name))
    ]
    if not numbered:
        raise ValueError(f"{folder}: no files localmap_<number>.txt (Linear SLAM text submaps)")
    return [path for _, path in sorted(numbered)]


def read_maps(paths: Iterable[Path]) -> tuple[list[TextMap], int]:
    """All maps and their dimension, 2 or 3: 3 where an id of most maps has six values, as every 3D pose has.

    In single maps of a 2D set six values are a pose that stands there twice.

    Raises
    ------
    ValueError
        With the file's name, for one that is not of this format.
    """
    raw = [(path, *_read(path)) for path in paths]
    dimension = 3 if 2 * sum(bool(np.any(sizes == 6)) for _, _, _, sizes, _, _ in raw) > len(raw) else 2
    maps = [_interpret(dimension, *item) for item in raw]
    if any(np.any(m.pose_ids < 0) for m in maps):
        maps = [replace(m, reference=-abs(m.reference)) for m in maps]
    return maps, dimension


def _read(path: Path) -> tuple[int, IntArray, IntArray, FloatArray, FloatArray]:
    """Reference, ids with the number of values of each, all values, information."""
    try:
        numbers = np.array(read_text(path).split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: not a text submap: {error}") from error
    if len(numbers) < 2:
        raise ValueError(f"{path}: holds {len(numbers)} numbers, a submap starts with its reference and its size")
    count = int(numbers[1]) if np.isfinite(numbers[1]) else -1
    if count < 1 or len(numbers) != 2 + 2 * count + count * count:
        raise ValueError(
            f"{path}: holds {len(numbers)} numbers, a submap of {count} values needs {2 + count * (2 + count)}"
        )
    if not np.all(np.isfinite(numbers)):
        raise ValueError(f"{path}: holds values that are not finite")
    state = numbers[2 : 2 + 2 * count].reshape(count, 2)
    starts = np.concatenate([[0], np.nonzero(np.diff(state[:, 0]))[0] + 1])
    sizes = np.diff(np.concatenate([starts, [count]]))
    _check_ids(path, numbers[0], state[starts, 0])
    information = numbers[2 + 2 * count :].reshape(count, count)
    if np.abs(information - information.T).max() > 1e-3 * np.abs(information).max():
        raise ValueError(f"{path}: the information matrix is not symmetric")
    return int(numbers[0]), np.stack([state[starts, 0].astype(np.int64), sizes]), sizes, state[:, 1], information


def _check_ids(path: Path, reference: float, ids: FloatArray) -> None:
    for value in (reference, *ids.tolist()):
        if value != int(value):
            raise ValueError(f"{path}: id {value} is not a whole number")


def _interpret(
    dimension: int,
    path: Path,
    reference: int,
    ids: IntArray,
    sizes: IntArray,
    values: FloatArray,
    information: FloatArray,
) -> TextMap:
    pose_size = 3 if dimension == 2 else 6
    ids, sizes = _split(ids, sizes, dimension)
    is_pose = sizes == pose_size
    if not np.all(is_pose | (sizes == dimension)):
        wrong = sizes[~is_pose & (sizes != dimension)][0]
        raise ValueError(
            f"{path}: an id has {wrong} values, {dimension}D poses have {pose_size}, features {dimension}"
            " (2D and 3D maps in one folder?)"
        )
    if np.any(ids[0, ~is_pose] <= 0):
        raise ValueError(f"{path}: feature id {ids[0, ~is_pose].min()} is not positive (a 2D map among 3D ones?)")
    of_pose = np.repeat(is_pose, sizes)
    order = np.argsort(~of_pose, kind="stable")  # poses first
    information = 0.5 * (information + information.T)[np.ix_(order, order)]
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise ValueError(f"{path}: the information matrix is not positive definite")
    read = TextMap(
        reference, ids[0, is_pose], values[of_pose].reshape(-1, pose_size),
        ids[0, ~is_pose], values[~of_pose].reshape(-1, dimension), information,
    )  # fmt: skip
    repeated = any(len(np.unique(own)) < len(own) for own in (read.pose_ids, read.feature_ids))
    return _each_once(read, dimension) if repeated else read


def _split(ids: IntArray, sizes: IntArray, dimension: int) -> tuple[IntArray, IntArray]:
    """Ids and sizes where values that stand together are those of the same id several times over."""
    pose_size = 3 if dimension == 2 else 6
    of_one = [
        next((size for size in (pose_size, dimension) if total % size == 0), total) if total > pose_size else total
        for total in sizes.tolist()
    ]  # fmt: skip
    times = sizes // np.array(of_one)
    whole = np.repeat(np.array(of_one), times)
    return np.stack([np.repeat(ids[0], times), whole]), whole


def _each_once(m: TextMap, dimension: int) -> TextMap:
    """The map with each id once: the mean and information of what the copies say together (least squares)."""
    pose_size = m.poses.shape[1]
    pose_ids, first_pose, pose_of = np.unique(m.pose_ids, return_index=True, return_inverse=True)
    feature_ids, first_feature, feature_of = np.unique(m.feature_ids, return_index=True, return_inverse=True)
    columns = np.concatenate([
        (pose_of.reshape(-1, 1) * pose_size + np.arange(pose_size)).ravel(),
        len(pose_ids) * pose_size + (feature_of.reshape(-1, 1) * dimension + np.arange(dimension)).ravel(),
    ])  # fmt: skip
    start = np.concatenate([m.poses[first_pose].ravel(), m.features[first_feature].ravel()])
    apart = np.concatenate([m.poses.ravel(), m.features.ravel()]) - start[columns]
    of_pose = np.tile(np.arange(pose_size) >= dimension, len(m.poses))
    is_angle = np.concatenate([of_pose, np.zeros(m.features.size, dtype=bool)])
    apart[is_angle] = (apart[is_angle] + np.pi) % (2.0 * np.pi) - np.pi
    J = np.zeros((len(columns), len(start)))
    J[np.arange(len(columns)), columns] = 1.0
    information = J.T @ m.information @ J
    mean = start + np.linalg.solve(information, J.T @ (m.information @ apart))
    poses = mean[: len(pose_ids) * pose_size].reshape(-1, pose_size)
    features = mean[poses.size :].reshape(-1, dimension)
    return TextMap(m.reference, pose_ids, poses, feature_ids, features, 0.5 * (information + information.T))


def write_covariances(path: Path, ids: Iterable[int], covariances: FloatArray) -> None:
    """Covariances (n, k, k) of joined poses or features, a line ``id`` and the k x k numbers, row by row, each."""
    write_values(path, ids, covariances.reshape(len(covariances), covariances.shape[1] ** 2))


def write_values(path: Path, ids: Iterable[int], values: FloatArray) -> None:
    """Joined poses or features, a line ``id value ...`` each, written under a temporary name and renamed."""
    temporary = path.with_name(path.name + ".part")
    lines = (f"{i} " + " ".join(f"{v:.17g}" for v in row) for i, row in zip(ids, values, strict=True))
    temporary.write_text("\n".join(lines) + "\n")
    temporary.replace(path)


Progress = Callable[[int, int], None]
