# SPDX-License-Identifier: Apache-2.0
"""Pairs what belongs to one instant by header stamp: exactly by default, within a tolerance where one is given.

Used by the nodes on messages and by the offline pipeline on a bag: both see the same sets and count the same losses.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from typing import Generic, TypeVar

T = TypeVar("T")

PAIRING_TOLERANCE_S = 0.004
"""Stamps that differ by less are taken for one instant, s: cameras with one trigger and a stamp each. Far less than the
time between two frames, so that equal stamps pair as if nothing else were allowed.
"""


class StampSynchronizer(Generic[T]):
    """Collects one item per topic and hands complete sets on, in the order of their arrival.

    A topic delivers in order, so once a set is complete nothing that came before it can become complete: what is left
    of that is counted in ``unpaired`` and dropped. Queues are bounded by ``depth``; what overflows is counted the same
    way.

    Parameters
    ----------
    topics
        Names of the inputs; the first one's stamp is the stamp of the set.
    on_set
        Called with (stamp_ns, items in the order of ``topics``).
    tolerance_ns
        Largest difference of an item's stamp from its neighbours' in the set; 0 pairs equal stamps only.
    depth
        Items kept per topic while waiting for the others.
    companions
        Topics that say something of the others' items and are nothing alone, such as camera infos: what is left over of
        these is dropped without being counted.
    """

    def __init__(
        self,
        topics: Sequence[str],
        on_set: Callable[[int, tuple[T, ...]], None],
        *,
        tolerance_ns: int = 0,
        depth: int = 64,
        companions: Collection[str] = (),
    ) -> None:
        if tolerance_ns < 0 or depth < 1:
            raise ValueError(f"pairing needs tolerance >= 0 ns and depth >= 1, got {tolerance_ns} ns and {depth}")
        self._queues: dict[str, OrderedDict[int, T]] = {topic: OrderedDict() for topic in topics}
        self._on_set = on_set
        self._tolerance_ns = tolerance_ns
        self._depth = depth
        self._companions = frozenset(companions)
        self.unpaired = 0
        """Items dropped because their partners never came."""

    def add(self, topic: str, stamp_ns: int, item: T) -> None:
        """Take one item; calls ``on_set`` before it returns if the item completes a set."""
        queue = self._queues[topic]
        if queue.pop(stamp_ns, None) is not None:
            self._count(topic)
        queue[stamp_ns] = item
        if len(queue) > self._depth:
            queue.popitem(last=False)
            self._count(topic)
        stamps = self._partners(stamp_ns)
        if stamps is not None:
            self._emit(stamps)

    def clear(self) -> None:
        """Forget everything that waits; what waited counts as unpaired."""
        for topic, queue in self._queues.items():
            self._count(topic, len(queue))
            queue.clear()

    @property
    def waiting(self) -> dict[str, int]:
        """Number of items waiting per topic."""
        return {topic: len(queue) for topic, queue in self._queues.items()}

    def _partners(self, stamp_ns: int) -> list[int] | None:
        """The stamp in each queue nearest to ``stamp_ns``, or None if one lacks a partner within the tolerance."""
        if self._tolerance_ns == 0:
            return [stamp_ns] * len(self._queues) if all(stamp_ns in q for q in self._queues.values()) else None
        stamps = []
        for queue in self._queues.values():
            nearest = min(queue, key=lambda s: abs(s - stamp_ns), default=None)
            if nearest is None or abs(nearest - stamp_ns) > self._tolerance_ns:
                return None
            stamps.append(nearest)
        return stamps

    def _emit(self, stamps: list[int]) -> None:
        items = []
        for (topic, queue), stamp in zip(self._queues.items(), stamps, strict=True):
            while (first := next(iter(queue))) != stamp:
                del queue[first]
                self._count(topic)
            items.append(queue.pop(stamp))
        self._on_set(stamps[0], tuple(items))

    def _count(self, topic: str, number: int = 1) -> None:
        if topic not in self._companions:
            self.unpaired += number
