# SPDX-License-Identifier: Apache-2.0
"""Views that an agent has, sent in pieces when a post lacks them.

The post says again and again what it lacks, piece by piece: a restart of the agent has nothing to remember but the
files. Of a view the first piece goes out alone: it says which image is coming, and the post may have that one.
"""

from __future__ import annotations

from collections.abc import Iterable

from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.queues.in_flight import InFlight
from slam_radio.views.view_files import ViewFiles
from slam_radio.wire.view_messages import (
    MOST_VIEWS,
    WINDOW,
    Lack,
    Piece,
    ViewKey,
    pack_piece,
    pack_unseen,
    pieces_of,
)

NEAR_NS = 2_000_000_000
"""An image that is farther from the stamp that is asked for is none of that place, ns."""


class ViewSender:
    """Views of an agent, and pieces of them that the post lacks. Times are those of any steady clock, s."""

    def __init__(self, files: ViewFiles, bytes_per_second: float, resend_after_s: float = 5.0) -> None:
        self.files = files
        self.sent = self.damaged = 0
        self._flight = InFlight(bytes_per_second, resend_after_s)
        self._lacks: list[Lack] = []
        self._unseen: list[ViewKey] = []
        self._pieces: dict[ViewKey, list[Piece]] = {}

    def lack(self, lacks: Iterable[Lack], now_s: float) -> None:
        """The post lacks these, and no others."""
        told = list(lacks)
        lacking = {lack.key: lack for lack in told}
        landed = [
            (key, piece.number)
            for key, pieces in self._pieces.items()
            for piece in pieces
            if key not in lacking or lacking[key].has(piece.number)
        ]
        self._flight.overtaken(landed, now_s)
        for entry in landed:
            self._flight.landed(entry)
        self._pieces = {key: pieces for key, pieces in self._pieces.items() if key in lacking}
        self._lacks, self._unseen = [], []
        for lack in told:
            if lack.key in self._pieces or self._load(lack.key):
                self._lacks.append(lack)
            else:
                self._unseen.append(lack.key)

    def _load(self, key: ViewKey) -> bool:
        """Read the image nearest to a stamp; False if there is none, or it is damaged."""
        while (found := self.files.nearest(key, NEAR_NS)) is not None:
            try:
                _, data = self.files.read(found)
            except (OSError, ValueError):
                self.files.set_aside(found)
                self.damaged += 1
                continue
            self._pieces[key] = pieces_of(key, found.stamp_ns, data)
            return True
        return False

    def hurry(self, now_s: float) -> None:
        """The post is back: what was under way may have been lost."""
        self._flight.hurry(now_s)

    def unseen(self) -> bytes | None:
        """Message of what the post asks for and this agent does not have; None if there is no such thing."""
        return pack_unseen(self._unseen[:MOST_VIEWS]) if self._unseen else None

    def unseen_is_sent(self) -> None:
        """That message goes out: the post will ask again if it is lost."""
        self._unseen = []

    def ready(self, now_s: float) -> Piece | None:
        """The piece that goes out next; None while there is none or enough is under way."""
        for lack in self._lacks:
            pieces = self._pieces[lack.key]
            is_other = lack.first >= len(pieces)  # the post has pieces of an image that is here no more
            window = pieces[lack.first : lack.first + WINDOW] if lack.has(0) and not is_other else pieces[:1]
            for piece in window:
                lacks = is_other or not lack.has(piece.number)
                if lacks and self._flight.is_due((lack.key, piece.number), now_s):
                    return piece if self._flight.fits(self.size(piece), now_s) else None
        return None

    def size(self, piece: Piece) -> int:
        """Bytes on the wire of a piece."""
        return len(pack_piece(piece)) + OVERHEAD

    def take(self, piece: Piece, now_s: float) -> bytes:
        """The message of a piece, which goes out now."""
        self._flight.sent((piece.key, piece.number), self.size(piece), now_s)
        self.sent += 1
        return pack_piece(piece)

    @property
    def resent(self) -> int:
        """Pieces that went out again."""
        return self._flight.resent
