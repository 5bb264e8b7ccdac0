# SPDX-License-Identifier: Apache-2.0
"""Views that a post has asked an agent for: pieces and whole ones on disk, and what is still lacking."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from slam_core.storage.files import atomic_path, atomic_text, read_bytes, read_json
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_format import PlacedImage, unpack_view
from slam_radio.wire.view_messages import MOST_VIEWS, PIECE_BYTES, Lack, Piece, ViewKey, unpack_piece

_SAME_NS = 100_000_000
"""An image that is there is shown instead of asking for one of so nearly the same moment, ns."""
_MOST_WANTED = 64
"""Requests; of more the oldest is given up."""
_MOST_LOOKS = 600
"""Looks in a row that an agent may leave without an answer: half an hour of a link that is up."""
_NAME = re.compile(r"([12])-(\d{1,10})-(\d{1,19})-(\d{1,5})\.piece")
_MOST_PIECE_FILE = PIECE_BYTES + 100


class ViewInbox:
    """The views of one agent at the post; a restart finds what was asked for and every piece that has come.

    ``finished``: views that the start has found whole. ``given_up``: how many requests are wanted no more
    because nobody answered, or newer ones are too many.
    """

    def __init__(self, agent: str, path: Path, most_bytes: float) -> None:
        self.agent = agent
        self.files = ViewFiles(path, most_bytes)
        self.repeated = self.damaged = self.given_up = self._unanswered = 0
        self._wanted_file, self._folder = path / "wanted.json", path / "pieces"
        self.wanted: list[ViewKey] = _read_keys(self._wanted_file)
        self._pieces: dict[ViewKey, dict[int, Piece]] = {key: {} for key in self.wanted}
        self._folder.mkdir(exist_ok=True)
        for file in sorted(self._folder.iterdir()):
            if _NAME.fullmatch(file.name):
                self._find(file)
        self.finished = self._finish()

    def _find(self, file: Path) -> None:
        """Take a piece of before; one that is damaged, or of a view that is not wanted any more, is removed."""
        try:
            piece = unpack_piece(read_bytes(file, _MOST_PIECE_FILE))
        except ValueError:
            piece = None
        others = self._pieces.get(piece.key) if piece is not None else None
        if piece is None or others is None or any(_differs(piece, other) for other in others.values()):
            file.unlink(missing_ok=True)
        else:
            others[piece.number] = piece

    def _finish(self) -> list[PlacedImage]:
        """Keep views of which the last piece came just before the end of the last run."""
        views = []
        for pieces in list(self._pieces.values()):
            piece = next(iter(pieces.values()), None)
            if piece is None or len(pieces) < piece.count or piece.key not in self._pieces:
                continue
            with suppress(OSError, ValueError):  # it is tried again when a piece comes, or all are asked for anew
                views.append(self._whole(piece))
        return views

    def ask(self, key: ViewKey) -> PlacedImage | None:
        """Want the view that is nearest to a stamp; returns it if it is here.

        Raises
        ------
        OSError
            If that cannot be noted.
        """
        found = self.files.nearest(key, _SAME_NS)
        if found is not None and (here := self._here(found)) is not None:
            return here
        if key not in self.wanted:
            self._set_wanted([*self.wanted, key])
            self._pieces[key] = {}
            self._unanswered = 0
            self._give_up_beyond(_MOST_WANTED)
        return None

    def lacks(self) -> list[Lack]:
        """Wanted views, newest request first, as many as a message names; an image that answers two is listed once."""
        first: dict[ViewKey, ViewKey] = {}
        for key in self.wanted:
            first.setdefault(self._shown(key) or key, key)
        return [Lack.of(key, self._pieces[key]) for key in list(first.values())[: -MOST_VIEWS - 1 : -1]]

    def count_look(self) -> None:
        """A look goes out; what an agent that is heard has not answered for very long is given up."""
        self._unanswered += 1
        if self._unanswered >= _MOST_LOOKS:
            with suppress(OSError):  # a full disk: they are given up at the next look
                self._give_up_beyond(0)

    def _give_up_beyond(self, most: int) -> None:
        for key in self.wanted[: max(len(self.wanted) - most, 0)]:
            self._drop(key)
            self.given_up += 1

    def _shown(self, key: ViewKey) -> ViewKey | None:
        """Kind, session and stamp of the image that answers a request, as far as a piece of it has said."""
        return next((_shown(piece) for piece in self._pieces[key].values()), None)

    def give_up(self, keys: Iterable[ViewKey]) -> int:
        """Want some no more, which the agent does not have; returns how many."""
        self._unanswered = 0
        gone = [key for key in set(keys) if key in self.wanted]
        for key in gone:
            self._drop(key)
        return len(gone)

    def take(self, data: bytes) -> PlacedImage | None:
        """Keep the piece of a message; returns the view if that is whole now, or is the one of another moment here.

        Raises
        ------
        ValueError
            If the piece is damaged or not asked for, or the view that all pieces make: it is then asked for anew.
        OSError
            If it cannot be written; it is then still lacking.
        """
        piece = unpack_piece(data)
        self._unanswered = 0
        key, pieces = piece.key, self._pieces.get(piece.key)
        if pieces is None:
            self.repeated += 1
            return None
        if (
            here := self._here(_shown(piece))
        ) is not None:  # the same image was nearest to another stamp that was asked for
            self._drop(key)
            return here
        if any(_differs(piece, other) for other in pieces.values()):
            self._forget_pieces(key)  # the agent has another image than before
            pieces = self._pieces[key]
        if piece.number in pieces:
            self.repeated += 1
        else:
            with atomic_path(self._file(piece)) as temporary:
                temporary.write_bytes(data)
            pieces[piece.number] = piece
        return self._whole(piece) if len(pieces) == piece.count else None

    def _whole(self, piece: Piece) -> PlacedImage:
        """The view of all its pieces, which is kept.

        Raises
        ------
        ValueError
            If they are no view: all is asked for again. Or if there is a file that is none: it is wanted no more.
        OSError
            If it cannot be written: that is tried again with the next piece that comes.
        """
        shown = _shown(piece)
        data = b"".join(self._pieces[piece.key][n].data for n in range(piece.count))
        try:
            if zlib.crc32(data) != piece.checksum:
                raise ValueError("the pieces of a view do not fit together")
            view = unpack_view(data)
            if (view.kind, view.session, view.stamp_ns) != shown:
                raise ValueError(f"a view of {view.session}/{view.stamp_ns} came as {shown}")
        except ValueError:
            self.damaged += 1
            self._forget_pieces(piece.key)
            raise
        try:
            self.files.add(shown, data)
        except ValueError:
            self._drop_shown(shown)
            raise
        self._drop_shown(shown)
        return view

    def _drop_shown(self, shown: ViewKey) -> None:
        for key in [k for k in self.wanted if self._shown(k) == shown]:
            self._drop(key)

    def _here(self, key: ViewKey) -> PlacedImage | None:
        """A view that is here whole; None if it is not, or damaged."""
        if key not in self.files.sizes:
            return None
        try:
            return self.files.read(key)[0]
        except (OSError, ValueError):
            self.files.set_aside(key)
            return None

    def _drop(self, key: ViewKey) -> None:
        self._set_wanted([k for k in self.wanted if k != key])
        self._forget_pieces(key)
        del self._pieces[key]

    def _forget_pieces(self, key: ViewKey) -> None:
        for piece in self._pieces[key].values():
            self._file(piece).unlink(missing_ok=True)
        self._pieces[key] = {}

    def _set_wanted(self, wanted: list[ViewKey]) -> None:
        atomic_text(self._wanted_file, json.dumps(wanted))
        self.wanted = wanted

    def forget(self) -> None:
        """Remove all that has come, and want nothing."""
        for key in list(self.wanted):
            self._drop(key)
        for key in list(self.files.sizes):
            self.files.remove(key)

    def close(self) -> None:
        """Let another process have the folder."""
        self.files.close()

    def _file(self, piece: Piece) -> Path:
        kind, session, stamp = piece.key
        return self._folder / f"{kind}-{session}-{stamp}-{piece.number}.piece"


def _shown(piece: Piece) -> ViewKey:
    """Kind, session and stamp of the image that a piece is of."""
    return piece.key._replace(stamp_ns=piece.shown_ns)


def _differs(piece: Piece, other: Piece) -> bool:
    """True if two pieces are not of one image."""
    return (piece.checksum, piece.count, piece.shown_ns) != (other.checksum, other.count, other.shown_ns)


def _read_keys(path: Path) -> list[ViewKey]:
    """The keys of a file, none where there is no file; ValueError if it is not one of ours."""
    if not path.exists():
        return []
    value = read_json(path)
    try:
        return [ViewKey(int(kind), int(session), int(stamp)) for kind, session, stamp in value]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} does not list views ({error}): move it away") from None
