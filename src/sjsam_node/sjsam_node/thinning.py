# SPDX-License-Identifier: Apache-2.0
"""Submaps with fewer landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.types import Submap


def thinned(submap: Submap, kept: IntArray) -> Submap:
    """The submap with some of its landmarks; the others are marginalised out."""
    if len(kept) == len(submap.landmarks):
        return submap
    rows = np.concatenate([np.arange(6), (6 + 3 * kept[:, None] + np.arange(3)).ravel()])
    return replace(
        submap,
        landmarks=submap.landmarks[kept],
        covariance=submap.covariance[np.ix_(rows, rows)],
        landmark_ids=submap.landmark_ids[kept],
        sightings=submap.sightings[kept],
        descriptors=submap.descriptors[kept],
    )
