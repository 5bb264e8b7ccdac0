# SPDX-License-Identifier: Apache-2.0
"""Report on a submap that was to be joined."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class JoinReport:
    """Report on one submap.

    accepted with reason otherwise; matched: its landmarks already in the map; new_landmarks; closures: links accepted
    now, as (agent, index) of the older submap; dropped: matches let go; components: parts of the map that hang
    together; chi2, variance_factor, iterations, converged and solver of the update; redundant: it shows nothing new;
    is_strained: the submaps contradict each other by more than ``consistency.max_variance_factor``; is_refined: further
    landmarks of one that was joined.
    """

    accepted: bool
    reason: str = ""
    matched: int = 0
    new_landmarks: int = 0
    closures: tuple[tuple[str, int], ...] = ()
    dropped: int = 0
    components: int = 0
    chi2: float = 0.0
    variance_factor: float = 1.0
    iterations: int = 0
    converged: bool = True
    solver: str = ""
    redundant: bool = False
    is_strained: bool = False
    is_refined: bool = False
