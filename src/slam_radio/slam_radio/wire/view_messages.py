# SPDX-License-Identifier: Apache-2.0
"""Messages about views (pictures and dense key frames): what the post lacks, pieces, and what there is not.

Little endian throughout. A view is named by what was asked for: u8 kind (1 picture, 2 dense key frame), u32 session,
i64 stamp ns. The agent answers with the image that is nearest to that stamp.

======  ===========================================================================================================
look    b"SK", u8 version (1), u32 CRC-32 of the rest; then for each view that the post lacks its name, u16 n and
        u64 bits: pieces below n have come, and of the pieces n to n + 63 those whose bit is set, the lowest bit
        being piece n. No views: nothing is lacking
piece   b"SP", u8 version (1), u32 CRC-32 of the rest; name, i64 stamp ns of the image that is sent, u16 number and
        u16 count of the pieces, u32 CRC-32 of the whole view, then up to 1000 bytes of it
unseen  b"SU", u8 version (1), u32 CRC-32 of the rest; then names of views that the agent does not have
======  ===========================================================================================================
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

PIECE_BYTES = 1000
MOST_VIEWS = 16
"""Views of one look."""
WINDOW = 64
"""Pieces from the first that is lacking on that a look tells of."""
MOST_PIECES = 2**20 // PIECE_BYTES + 1
_VERSION = 1
_LOOK, _PIECE, _UNSEEN = b"SK", b"SP", b"SU"
_ENVELOPE = struct.Struct("<2sBI")
_NAME = struct.Struct("<BIq")
_LACKING = struct.Struct("<BIqHQ")
_HEAD = struct.Struct("<BIqqHHI")


class ViewKey(NamedTuple):
    """Name of a view: ``kind`` 1 picture, 2 dense key frame."""

    kind: int
    session: int
    stamp_ns: int


class Lack(NamedTuple):
    """A view of which pieces below ``first`` have come, and those of ``first + k`` whose bit k is set."""

    key: ViewKey
    first: int = 0
    bits: int = 0

    def has(self, number: int) -> bool:
        """True if a piece has come."""
        return number < self.first or bool(self.bits >> (number - self.first) & 1)

    @classmethod
    def of(cls, key: ViewKey, numbers: Iterable[int]) -> Lack:
        """The view and the pieces that have come."""
        come = set(numbers)
        first = next(n for n in range(len(come) + 1) if n not in come)
        return cls(key, first, sum(1 << (n - first) for n in come if first <= n < first + WINDOW))


@dataclass(frozen=True)
class Piece:
    """Piece ``number`` of the ``count`` of a view whose bytes have a CRC-32; ``shown_ns``: stamp of its image."""

    key: ViewKey
    shown_ns: int
    number: int
    count: int
    checksum: int
    data: bytes


def pack_look(lacks: Iterable[Lack]) -> bytes:
    """The first :data:`MOST_VIEWS` of the views that the post lacks."""
    return _sealed(_LOOK, b"".join(_LACKING.pack(*k.key, k.first, k.bits) for k in list(lacks)[:MOST_VIEWS]))


def unpack_look(data: bytes) -> list[Lack]:
    """Inverse of :func:`pack_look`; ValueError if it is damaged."""
    rest = _opened(_LOOK, data, "a look", _LACKING.size)
    return [Lack(_key(*name), first, bits) for *name, first, bits in _LACKING.iter_unpack(rest)]


def pack_unseen(keys: Iterable[ViewKey]) -> bytes:
    """The first :data:`MOST_VIEWS` of the views that the agent does not have."""
    return _sealed(_UNSEEN, b"".join(_NAME.pack(*key) for key in list(keys)[:MOST_VIEWS]))


def unpack_unseen(data: bytes) -> list[ViewKey]:
    """Inverse of :func:`pack_unseen`; ValueError if it is damaged."""
    return [_key(*name) for name in _NAME.iter_unpack(_opened(_UNSEEN, data, "an unseen", _NAME.size))]


def pieces_of(key: ViewKey, shown_ns: int, data: bytes) -> list[Piece]:
    """The pieces of a view's bytes, which was asked for as ``key``."""
    parts = [data[at : at + PIECE_BYTES] for at in range(0, len(data), PIECE_BYTES)]
    checksum = zlib.crc32(data)
    return [Piece(key, shown_ns, n, len(parts), checksum, part) for n, part in enumerate(parts)]


def pack_piece(piece: Piece) -> bytes:
    """The message of a piece: 36 bytes and its own."""
    head = _HEAD.pack(*piece.key, piece.shown_ns, piece.number, piece.count, piece.checksum)
    return _sealed(_PIECE, head + piece.data)


def unpack_piece(data: bytes) -> Piece:
    """Inverse of :func:`pack_piece`; ValueError if it is damaged."""
    rest = _opened(_PIECE, data, "a piece")
    if not _HEAD.size < len(rest) <= _HEAD.size + PIECE_BYTES:
        raise ValueError(f"a piece cannot have {len(data)} bytes")
    kind, session, stamp, shown, number, count, checksum = _HEAD.unpack_from(rest)
    body = rest[_HEAD.size :]
    if shown < 0 or not number < count <= MOST_PIECES or (number + 1 < count and len(body) != PIECE_BYTES):
        raise ValueError(f"a piece {number} of {count} with {len(body)} bytes cannot be")
    return Piece(_key(kind, session, stamp), shown, number, count, checksum, body)


def _key(kind: int, session: int, stamp: int) -> ViewKey:
    if kind not in (1, 2) or stamp < 0:
        raise ValueError(f"a view of kind {kind} at {stamp} ns cannot be")
    return ViewKey(kind, session, stamp)


def _sealed(magic: bytes, rest: bytes) -> bytes:
    return _ENVELOPE.pack(magic, _VERSION, zlib.crc32(rest)) + rest


def _opened(magic: bytes, data: bytes, name: str, entry: int = 0) -> bytes:
    """The rest of a message; of entries of a size at most :data:`MOST_VIEWS`."""
    rest = data[_ENVELOPE.size :]
    if len(data) < _ENVELOPE.size or (entry and (len(rest) % entry or len(rest) > MOST_VIEWS * entry)):
        raise ValueError(f"{name} cannot have {len(data)} bytes")
    if _ENVELOPE.unpack_from(data) != (magic, _VERSION, zlib.crc32(rest)):
        raise ValueError(f"not {name} of version {_VERSION}, or damaged")
    return rest
