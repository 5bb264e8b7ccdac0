# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags: black squares of known size whose pattern is a number.

A tag is four landmarks, its corners, in the order of OpenCV's detector: top left, top right, bottom right, bottom left
as one reads the tag. Their ids are negative and say the tag and the corner, so that they mean the same to every agent
on every day; those of other landmarks are not negative. The frame of a tag lies in its middle: x to the right, y up, z
out of the wall.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

CORNERS = 4
LARGEST_TAG = 2**20
"""Tags beyond this have corners whose ids a 32 bit float cannot say exactly."""


def corner_ids(tags: Sequence[int] | IntArray) -> IntArray:
    """Ids (4n,) of the corners of tags (n,)."""
    return np.asarray(-1 - (CORNERS * np.asarray(tags, dtype=np.int64)[:, None] + np.arange(CORNERS)).ravel())


def is_tag_corner(ids: npt.NDArray[np.integer]) -> BoolArray:
    """Mask (n,) of the ids that are of corners of tags."""
    return np.asarray((ids < 0) & (ids >= -CORNERS * LARGEST_TAG))


def whole_tags(ids: npt.NDArray[np.integer]) -> dict[int, IntArray]:
    """Rows of the four corners of each tag among ids (n,), by tag; a tag without one of them is left out."""
    at = {int(ids[k]): k for k in np.nonzero(is_tag_corner(ids))[0].tolist()}
    tags = sorted({(-1 - value) // CORNERS for value in at})
    wanted = {tag: corner_ids([tag]).tolist() for tag in tags}
    return {tag: np.array([at[i] for i in own]) for tag, own in wanted.items() if all(i in at for i in own)}


def square(size: float) -> FloatArray:
    """Corners (4, 3) of a tag in its own frame; ``size``: edge of the black square, m."""
    return 0.5 * size * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
