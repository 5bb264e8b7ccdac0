# SPDX-License-Identifier: Apache-2.0
"""Findings of tasks about the submaps of a union, by the records of the map that these are joined to.

The numbers differ: the map may have a record of the building's tags that no map brought, and may refuse a submap.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from sjsam_node.global_map import GlobalMap
from sjsam_node.loop_closure.association import Alignment
from sjsam_node.loop_closure.detector import Found, RecordPair, compared
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.merging.across import AcrossMaps
from sjsam_node.merging.union import Union

Looks = Mapping[tuple[int, ...], Alignment | None]


class ByRecords(Looks):
    """Alignments by looks that were found ahead, by pairs of records, and comparisons of records.

    Parameters
    ----------
    merged
        The map; more may be joined to it at any time.
    union, across
        What is joined, and where it is compared.
    """

    def __init__(self, merged: GlobalMap, union: Union, across: AcrossMaps) -> None:
        self._merged, self._across, self._looks = merged, across, across.looks
        self._number = {(s.agent, s.session, s.index): number for number, s in enumerate(union.submaps)}
        self._record = {number: key for key, number in self._number.items()}

    def number(self, record: int) -> int | None:
        """Number of a record in the union; None for what the map has placed itself."""
        return self._number.get(self._merged.state.graph.records[record].key)

    def __getitem__(self, key: tuple[int, ...]) -> Alignment | None:
        first, second = (self.number(record) for record in key)
        if first is None or second is None:
            raise KeyError(key)
        return self._looks[first, second]

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        for numbers in self._looks:
            records = [self._merged.agents.record(*self._record[number]) for number in numbers]
            if None not in records:
                yield tuple(record for record in records if record is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def compare(self, wanted: Sequence[RecordPair]) -> list[Found]:
        """Comparisons, as :attr:`LoopDetector.compare` asks for them; of what the map has placed itself, here."""
        found: dict[int, Found] = {}
        elsewhere: dict[int, RecordPair] = {}
        for k, one in enumerate(wanted):
            first, second = self.number(one.first), self.number(one.second)
            if first is None or second is None:
                records = self._merged.state.graph.records
                points = at_start(records[one.first]), at_start(records[one.second])
                found[k] = compared(self._merged.detector.verifier, *points, one)
            else:
                elsewhere[k] = replace(one, first=first, second=second)
        found |= zip(elsewhere, self._across.compare(list(elsewhere.values())), strict=True)
        return [found[k] for k in range(len(wanted))]
