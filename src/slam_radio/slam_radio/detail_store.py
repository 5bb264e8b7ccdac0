# SPDX-License-Identifier: Apache-2.0
"""Details that an agent keeps, and sends to a post that wants them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from slam_core.types import Submap
from slam_radio.index_ranges import IndexRanges, Key, Range
from slam_radio.packing.light_submap import LightSubmap
from slam_radio.packing.submap_details import key_of_details, pack_details
from slam_radio.submap_folder import SubmapFolder

_LONGEST_WAIT_S = 60.0


class DetailStore:
    """Details of an agent's submaps, and those of them that the post wants.

    The post says again and again what it lacks: what it wants no more it has. A restart of the agent has nothing to
    remember but the details themselves.
    """

    def __init__(self, path: Path, resend_after_s: float = 5.0) -> None:
        self.folder = SubmapFolder(path, key_of_details)
        self.sent = 0
        self._resend_after_s = resend_after_s
        self._wanted: list[Key] = []
        self._due: dict[Key, tuple[int, float]] = {}

    def keep(self, key: Key, submap: Submap, light: LightSubmap, message: bytes) -> bool:
        """Pack and keep what the message of a submap leaves out; False if a number is too large to be sent.

        Raises
        ------
        OSError
            If they cannot be written.
        """
        try:
            details = pack_details(submap, light, message)
        except ValueError:
            return False
        if details is not None:
            self.folder.add(key, details)
        return True

    def want(self, ranges: Iterable[Range]) -> None:
        """The post lacks these, and no others."""
        lacking = IndexRanges(ranges)
        self._wanted = [key for key in sorted(self.folder.sizes) if key in lacking]
        self._due = {key: due for key, due in self._due.items() if key in self._wanted}

    def hurry(self, now_s: float) -> None:
        """The post is back: what was under way may have been lost."""
        self._due = {key: (1, min(due, now_s + self._resend_after_s)) for key, (_, due) in self._due.items()}

    def ready(self, now_s: float) -> Key | None:
        """Key of the details that go out next, None while there are none."""
        return next((key for key in self._wanted if self._due.get(key, (0, now_s))[1] <= now_s), None)

    def take(self, key: Key, now_s: float) -> bytes | None:
        """The bytes of details that go out now; None if their file is gone, which is not tried again."""
        tries = self._due.get(key, (0, 0.0))[0] + 1
        self._due[key] = tries, now_s + min(self._resend_after_s * 2.0 ** (tries - 1), _LONGEST_WAIT_S)
        try:
            data = self.folder.read(key)
        except OSError:
            self._wanted.remove(key)
            return None
        self.sent += 1
        return data
