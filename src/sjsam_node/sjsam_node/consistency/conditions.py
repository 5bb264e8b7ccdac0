# SPDX-License-Identifier: Apache-2.0
"""Conditions on a joined map for a closure to be held, and what was decided about closures.

Three tests decide, and none of them changes the map: closures against each other and the odometry
(:mod:`sjsam_node.consistency.pairwise`), closures against the joined map (:mod:`sjsam_node.consistency.map_test`),
and submaps that contradict each other whatever is held (:mod:`sjsam_node.consistency.overconfidence`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sjsam_node.graph.links import Link
from slam_core.config import Config, parameter

OUTLIER_PROBABILITY = 0.99999
"""Share of true matches that a joined map keeps."""
OUTLIER_SHARE = 0.1
"""Largest share of a submap's matches that are removed at once."""
SETTLING_ROUNDS = 6
"""Updates by which a map that settles may lose closures, at most."""
CLOSURE_PROBABILITY = 0.9999
"""Share of true closures whose rise of chi2 is accepted."""
VIEW_CHANGE_FACTOR = 2.0
"""Factor by which squared errors of matches from another view are larger than those in a whole map."""
RETRY_GROWTH = 1.2
"""Growth of the landmarks that speak for refused closures, from which these are tried again."""
JOINING_ROUNDS = 1
"""Updates that a submap may cost beyond its first, to remove closures."""
MAX_REFUSED_CLOSURES = 40
"""Refused closures that are remembered."""


@dataclass(frozen=True)
class ConsistencyConfig(Config):
    """Conditions on a joined map for a closure to be held."""

    max_variance_factor: float = parameter(
        16.0,
        "a map whose submaps seem too sure of themselves by more than this factor holds false closures",
        minimum=1.0,
    )


@dataclass(frozen=True, eq=False)
class Verdict:
    """The new closures that are held, the number of matches removed, and old closures removed whole."""

    accepted: tuple[Link, ...] = ()
    dropped: int = 0
    removed: tuple[Link, ...] = ()


def verdict_on(added: Sequence[Link], offered: Sequence[Link], held: Sequence[Link]) -> Verdict:
    """Verdict on the links ``offered``, of which ``added`` are new, of which the map has ``held`` these."""
    kept, were = set(held), set(offered)
    gone, smaller = [k for k in offered if k not in kept], [k for k in held if k not in were]
    lost = {k.ends for k in gone if k.is_closure} - {k.ends for k in smaller if k.is_closure}
    removed = tuple(k for k in gone if k.is_closure and k.ends in lost and not is_among(k, added))
    dropped = sum(len(k.pairs) for k in gone) - sum(len(k.pairs) for k in smaller)
    return Verdict(tuple(k for k in added if k.ends not in lost), dropped, removed)


def is_among(link: Link, links: Iterable[Link]) -> bool:
    """True if a link between the same two records is among others."""
    return any(k.ends == link.ends for k in links)
