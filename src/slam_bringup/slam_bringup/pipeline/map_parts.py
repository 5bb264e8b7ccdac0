# SPDX-License-Identifier: Apache-2.0
"""Names the parts of a map that nothing ties together, by their submaps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby


def parts_in_words(submaps: Iterable[tuple[int, str, int]]) -> str:
    """Parts of a map of (part, agent, index) in words, or "" if it is whole: "one 0-4, 7; two 0-3"."""
    of_part: dict[int, dict[str, list[int]]] = {}
    for part, agent, index in submaps:
        of_part.setdefault(part, {}).setdefault(agent, []).append(index)
    if len(of_part) < 2:
        return ""
    texts = [
        " with ".join(f"{agent or 'submaps'} {_ranges(sorted(indices))}" for agent, indices in agents.items())
        for agents in of_part.values()
    ]
    return "; ".join(texts)


def _ranges(indices: Sequence[int]) -> str:
    """Ascending numbers, neighbours as a range: "0-4, 7"."""
    runs = [[i for _, i in run] for _, run in groupby(enumerate(indices), key=lambda pair: pair[1] - pair[0])]
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
