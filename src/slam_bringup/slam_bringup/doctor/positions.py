# SPDX-License-Identifier: Apache-2.0
"""Checks that positions in a fixed frame say how good they are, and are spread so that the frame can be found."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sjsam_node.positions.position_queue import FARTHEST, LARGEST_SIGMA, is_usable
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding

_FEWEST = 8
_SPREAD = 3.0
"""Least spread across the way, in standard deviations of one position."""


def check_positions(evidence: Evidence) -> Iterator[Finding]:
    """Covariances that cannot be used, distances from the origin, and positions along one line."""
    readings = evidence.positions
    if not readings:
        return
    topic = evidence.name("position")
    usable = [reading for reading in readings if is_usable(reading.covariance)]
    if len(usable) < len(readings):
        yield Finding(
            "position covariance",
            f"{len(readings) - len(usable)} of {len(readings)} positions on {topic} have a covariance of zero, or not "
            f"finite, or beyond {LARGEST_SIGMA:g} m along an axis",
            "they are not used: let the driver fill x, y and z of pose.covariance; of a height that it does not "
            "measure, how far the antenna may be from the one that it gives",
        )
    if not usable:
        return
    places = np.array([reading.position for reading in usable])
    if np.abs(places).max() > FARTHEST:
        yield Finding(
            "position frame",
            f"positions on {topic} are up to {np.abs(places).max() / 1000:.0f} km from their origin",
            "give them in a local frame that begins near the building",
        )
    sigma = float(np.sqrt(np.median([np.linalg.eigvalsh(r.covariance)[-1] for r in usable])))
    across = np.sqrt(max(np.linalg.eigvalsh(np.cov(places.T))[1], 0.0)) if len(usable) >= _FEWEST else 0.0
    if across < _SPREAD * sigma:
        yield Finding(
            "position spread",
            f"{len(usable)} positions on {topic} lie along a line or in one place: {across:.2f} m across it, each to "
            f"{sigma:.2f} m",
            "where their frame lies in the map can be told after a turn into another direction; until then they wait",
        )
