# SPDX-License-Identifier: Apache-2.0
"""Text submaps of Linear SLAM (Zhao, Huang and Dissanayake, IROS 2013), 2D and 3D, with landmarks or as pose graphs.

A file ``localmap_<k>.txt`` holds: ``Ref``, the id of the pose whose frame the map is in; N; N lines ``id value``; the
N x N information matrix. The values of one id stand together: a pose is x y phi in 2D and x y z yaw pitch roll in 3D
(so that the rotation to the reference frame is ``Rz(yaw) Ry(pitch) Rx(roll)``), a feature x y or x y z. Ids of
features are positive; poses count down from 0 in sets with features and up in pose graphs, so that a pose and a
feature may share a number. Where poses count down, ``Ref`` is written without its sign.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.linear_algebra.sparse_cholesky import IntArray


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
    """All maps and their dimension, 2 or 3; the dimension is 3 where any id has six values.

    Raises
    ------
    ValueError
        With the file's name, for one that is not of this format.
    """
    raw = [(path, *_read(path)) for path in paths]
    dimension = 3 if any(np.any(sizes == 6) for _, _, _, sizes, _, _ in raw) else 2
    maps = [_interpret(dimension, *item) for item in raw]
    if any(np.any(m.pose_ids < 0) for m in maps):
        maps = [replace(m, reference=-abs(m.reference)) for m in maps]
    return maps, dimension


def _read(path: Path) -> tuple[int, IntArray, IntArray, FloatArray, FloatArray]:
    """Reference, ids with the number of values of each, all values, information."""
    try:
        numbers = np.array(path.read_text(encoding="utf-8-sig").split(), dtype=np.float64)
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
    unique, count = np.unique(ids, return_counts=True)
    if count.max() > 1:
        raise ValueError(f"{path}: the values of id {int(unique[count.argmax()])} do not stand together")


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
    return TextMap(
        reference, ids[0, is_pose], values[of_pose].reshape(-1, pose_size),
        ids[0, ~is_pose], values[~of_pose].reshape(-1, dimension), information,
    )  # fmt: skip


def write_values(path: Path, ids: Iterable[int], values: FloatArray) -> None:
    """Joined poses or features, a line ``id value ...`` each, written under a temporary name and renamed."""
    temporary = path.with_name(path.name + ".part")
    lines = (f"{i} " + " ".join(f"{v:.17g}" for v in row) for i, row in zip(ids, values, strict=True))
    temporary.write_text("\n".join(lines) + "\n")
    temporary.replace(path)


Progress = Callable[[int, int], None]
