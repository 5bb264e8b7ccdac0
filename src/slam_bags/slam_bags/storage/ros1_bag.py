# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 (``.bag``) with the face of the rosbag2 reader: messages come as the CDR bytes of their ROS 2 types."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError

from slam_bags.storage.bag_types import typestore


class Ros1Reader:
    """Reads one ``.bag`` file; types that ROS 2 Jazzy does not have are passed over.

    Raises
    ------
    ValueError
        If the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._reader = Reader(path)

    def open(self) -> None:
        """Read the index."""
        try:
            self._reader.open()
        except ReaderError as error:
            hint = " (rosbag reindex mends a bag that was not closed)" if "index" in str(error) else ""
            raise ValueError(f"{error}{hint}") from error

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    @property
    def connections(self) -> list[Connection]:
        """One per publisher: a topic may have several."""
        known = typestore().fielddefs
        return [c for c in self._reader.connections if c.msgtype in known]

    @property
    def start_time(self) -> int:
        """Time of the first message, ns."""
        return self._reader.start_time

    @property
    def duration(self) -> int:
        """Time from the first message to just after the last, ns."""
        return self._reader.duration

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages in the order of their time, from ``start`` until before ``stop``: connection, ns, CDR bytes."""
        for connection, stamp, data in self._reader.messages(connections, start, stop):
            yield connection, stamp, bytes(typestore().ros1_to_cdr(data, connection.msgtype))
