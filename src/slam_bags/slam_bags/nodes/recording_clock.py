# SPDX-License-Identifier: Apache-2.0
"""The time of a recording by header stamps, for messages that have none as well.

A transform list, an array of markers or what is latched says nothing of when it was sent: it gets the newest stamp that
any other message had. What comes before the first stamp waits for it. So the recording spans the sensors' time, however
long ago that was.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

from slam_bags.storage.bag_types import typestore

T = TypeVar("T")


class RecordingClock(Generic[T]):
    """Gives every item a stamp, in the order in which they come."""

    def __init__(self) -> None:
        self._newest_ns = 0
        self._waiting: list[T] = []

    def stamped(self, item: T, stamp_ns: int) -> Iterator[tuple[T, int]]:
        """The items whose stamps are known now; ``stamp_ns``: the item's own, 0 where it has none."""
        self._waiting.append(item)
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if self._newest_ns:
            *before, _ = self._waiting
            self._waiting = []
            yield from ((other, self._newest_ns) for other in before)
            yield item, stamp_ns or self._newest_ns

    def rest(self, stamp_ns: int) -> Iterator[tuple[T, int]]:
        """The items that still wait, where no message had a stamp."""
        waiting, self._waiting = self._waiting, []
        yield from ((item, stamp_ns) for item in waiting)


def has_header(type_name: str) -> bool:
    """True if messages of a type begin with a header."""
    fields = typestore().fielddefs[type_name][1]
    return bool(fields) and fields[0][0] == "header"


def topic_name(topic: str) -> str:
    """Last part of a topic's name."""
    return topic.rsplit("/", 1)[-1]
